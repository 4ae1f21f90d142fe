# SPDX-License-Identifier: Apache-2.0
"""A cloud from several viewpoints at once: each sensor's own points, and the space that each saw to be free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.body.cloud.correspondence import VertexQuadratic
from flowing_puppet_ros.body.cloud.normals import downsample
from flowing_puppet_ros.body.cloud.single_view import MAX_VIEW_POINTS, SingleViewCloud
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.cloud.nearest import NearestPoints
from flowing_puppet_ros.evidence.cloud.one_sided import OneSidedView
from flowing_puppet_ros.evidence.cloud.sensor_rig import SensorRig

MAX_RIG_POINTS = 6000
"""Of all sensors together; more add time and no accuracy."""
MIN_VIEW_POINTS = 20
"""Points of a person from which on a sensor says what space is free."""


@dataclass(frozen=True, slots=True, eq=False)
class RigView:
    """The views of several sensors, as one `OneSidedView` is asked."""

    views: tuple[OneSidedView, ...]

    @property
    def viewpoints(self) -> F64:
        """Where the sensors are, (S, 3) m."""
        return np.stack([view.viewpoint for view in self.views])

    def misfit(self, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what `OneSidedView.misfit` does: the mean of the sensors' distances, and what faces any of them."""
        cost, facing = np.zeros(len(points)), np.zeros(points.shape[:2], dtype=np.bool_)
        for view in self.views:
            own, faces = view.misfit(points, normals)
            cost += own / len(self.views)
            facing |= faces
        return cost, facing


@dataclass(frozen=True, slots=True, eq=False)
class RigCloud(SingleViewCloud):
    """A cloud to fit that several sensors saw.

    `view` is a `RigView`, `field` the `SensorRig`, `viewpoint` the middle of the sensors.

    Attributes:
        parts: what each sensor saw.
    """

    parts: tuple[SingleViewCloud, ...]

    @classmethod
    def seen_by(cls, points: F64, rig: SensorRig) -> SingleViewCloud:
        """Downsample and index a person's points (N, 3) m; normals turn to the sensor that saw each point.

        Raises:
            InputError: when part of the cloud lies behind its sensor, or no sensor saw enough of it.
        """
        most = min(MAX_VIEW_POINTS, MAX_RIG_POINTS // max(len(np.unique(rig.owner)), 1))
        parts, numbers = [], []
        for number, (viewpoint, field) in enumerate(zip(rig.viewpoints, rig.fields, strict=True)):
            own = points[rig.owner == number]
            if len(own) >= MIN_VIEW_POINTS:
                own = downsample(own, None, most)[0]
                parts.append(SingleViewCloud.seen_from(own, None, viewpoint, field=field))
                numbers.append(np.full(len(own), number))
        if not parts:
            raise InputError(f"none of the sensors saw {MIN_VIEW_POINTS} points of the {len(points)} of a person")
        merged = np.concatenate([part.points for part in parts])
        return cls(
            merged,
            np.concatenate([part.normals for part in parts]),
            NearestPoints(merged),
            rig.viewpoints.mean(axis=0),
            rig.own(np.concatenate(numbers)),
            RigView(tuple(part.view for part in parts)),  # type: ignore[arg-type]
            max(part.plane_noise for part in parts),
            tuple(parts),
        )

    def sees(self, vertices: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return which vertices (V,) at least one sensor sees."""
        return np.any([part.sees(vertices, normals) for part in self.parts], axis=0)

    def free_space_term(self, vertices: np.ndarray, sigma: float) -> VertexQuadratic:
        """Return the mean of the quadratics that pull vertices (V, 3) out of the space each sensor saw to be free."""
        total = VertexQuadratic.sum([part.free_space_term(vertices, sigma) for part in self.parts])
        return VertexQuadratic(total.matrix / len(self.parts), total.vector / len(self.parts))
