# SPDX-License-Identifier: Apache-2.0
"""Errors of the measurements of fitted people, against those of the same people's own surface at rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.body.measurements.measure import DEFINITIONS, measure, measure_fit
from flowing_puppet_ros.evaluate.body.synthetic_bodies import TrueBody
from flowing_puppet_ros.model import weights
from flowing_puppet_ros.model.sp import StitchedPuppet

MAX_ERROR_M = 0.01
"""Error of a length that is asked for."""


def measure_errors(model: StitchedPuppet, fit: BodyFit, body: TrueBody, triangles: np.ndarray) -> dict[str, float]:
    """Return the errors of a fit's measurements, m and m3.

    The truth is measured on Anny's own mesh (`triangles`) at rest, with the joints that the model has in its vertices.
    """
    assert body.rest is not None
    own = body.rest.vertices
    joints = model.joints(own[weights.load("sp", model.name)["anny_vertex"]])
    truth = measure(own, triangles, dict(zip(model.joint_names, joints, strict=True)))
    found = measure_fit(model, fit.state, fit.vertices)
    return {name: found[name] - truth[name] for name in DEFINITIONS}


def summarise_errors(errors: Sequence[Mapping[str, float]]) -> list[dict[str, float | str]]:
    """Return a row for each measurement: mean, mean absolute and worst error, cm and litres, and how many are small."""
    rows: list[dict[str, float | str]] = []
    for name, definition in DEFINITIONS.items():
        scale, unit = (1000, "l") if definition.unit == "m3" else (100, "cm")
        values = scale * np.array([each[name] for each in errors])
        rows.append(
            {
                "measurement": name,
                "unit": unit,
                "bias": float(values.mean()),
                "mean_error": float(np.abs(values).mean()),
                "worst": float(np.abs(values).max()),
                f"within_{100 * MAX_ERROR_M:.0f}": int((np.abs(values) <= 100 * MAX_ERROR_M).sum()),
            }
        )
    return rows
