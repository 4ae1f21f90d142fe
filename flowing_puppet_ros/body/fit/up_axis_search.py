# SPDX-License-Identifier: Apache-2.0
"""Fits clouds whose up axis is not known: compares the directions coarsely and fits in the best ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter, check_cloud
from flowing_puppet_ros.body.fit.hypotheses import Progress, sub_progress
from flowing_puppet_ros.body.scans.scan_frame import ScanFrame, rotation_to_z_up

MAX_FITS = 3  # directions that are fitted in


def fit_in_best_frame(
    fitter: BodyFitter,
    points: np.ndarray,
    normals: np.ndarray | None,
    *,
    scale: float,
    ups: Sequence[np.ndarray],
    sensor: np.ndarray | None = None,
    progress: Progress,
) -> tuple[ScanFrame, BodyFit]:
    """Fit a cloud of one person in the frame that explains it best.

    The directions are ordered by `BodyFitter.coarse_cost`; at most three are fitted in, until a fit is reliable.

    Args:
        fitter: fitter of the model.
        points: (N, 3) in the scan's frame and unit.
        normals: (N, 3) in the scan's frame, or None.
        scale: metres per unit.
        ups: candidate directions (3,) in the scan's frame.
        sensor: (3,) position of the sensor in the scan's frame and unit, for a single view.
        progress: called with the fraction done.

    Returns:
        The frame and the fit, in metres with z up.

    Raises:
        InputError: when the cloud cannot be the surface of a person.
    """
    points, normals = check_cloud(points, normals)
    frames = [ScanFrame(scale, rotation_to_z_up(up)) for up in ups]
    if len(frames) > 1:
        costs = [fitter.coarse_cost(frame.to_body(points), _to_body(frame, sensor)) for frame in frames]
        frames = [frames[index] for index in np.argsort(costs, kind="stable")[:MAX_FITS]]
    fits: list[tuple[ScanFrame, BodyFit]] = []
    for number, frame in enumerate(frames):
        fit = fitter.fit(
            frame.to_body(points),
            None if normals is None else normals @ frame.rotation.T,
            viewpoint=_to_body(frame, sensor),
            progress=sub_progress(progress, number / len(frames), (number + 1) / len(frames)),
        )
        fits.append((frame, fit))
        if fit.reliable:
            break
    progress(1.0)
    return min(fits, key=lambda pair: pair[1].two_way_distance)


def _to_body(frame: ScanFrame, sensor: np.ndarray | None) -> np.ndarray | None:
    return None if sensor is None else frame.to_body(sensor)
