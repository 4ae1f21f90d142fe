# SPDX-License-Identifier: Apache-2.0
"""A cloud from one sensor: what of a body it should have seen, and the space that it saw to be free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from flowing_puppet_ros.body.cloud.correspondence import Cloud, VertexQuadratic
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.cloud.nearest import NearestPoints
from flowing_puppet_ros.evidence.cloud.one_sided import OneSidedView

VIEW_POINTS = 4000
"""More points than that of one side add time and no accuracy."""
NEAREST = 0.05
"""Metres before the sensor."""
DEPTH_TOLERANCE, NOISES, NOISE_NEIGHBOURS = 0.01, 2.5, 6
"""Metres, and multiples of the noise, before the seen surface up to which a vertex is left alone. Noise that counted on
one side only would push the body away from the sensor."""


@dataclass(frozen=True, slots=True, eq=False)
class SingleViewCloud(Cloud):
    """A cloud to fit that was seen from one place.

    Attributes:
        view: the cloud as its sensor saw it.
        before: metres before the seen surface up to which a vertex is left alone.
    """

    view: OneSidedView
    depth_tolerance: float

    @classmethod
    def seen_from(cls, points: np.ndarray, normals: np.ndarray, viewpoint: np.ndarray) -> SingleViewCloud:
        """Index a cloud; arguments as of `Cloud`.

        Raises:
            InputError: when part of the cloud lies behind the sensor.
        """
        forward = points.mean(axis=0) - viewpoint
        if ((points - viewpoint) @ forward <= NEAREST * np.linalg.norm(forward)).any():
            raise InputError(
                f"the sensor at {np.round(viewpoint, 2).tolist()} m stands within the cloud and cannot have seen one"
                " side of it; check the frame or fit it as a whole cloud"
            )
        near = points[cKDTree(points).query(points, k=min(NOISE_NEIGHBOURS, len(points)))[1]]
        noise = float(np.median(np.abs(((near - points[:, None]) * normals[:, None]).sum(axis=2)[:, 1:])))
        view = OneSidedView.build(points, viewpoint)
        return cls(points, normals, NearestPoints(points), viewpoint, view, max(DEPTH_TOLERANCE, NOISES * noise))

    def sees(self, vertices: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Which vertices (V,) face the sensor and are not hidden by what it saw."""
        facing = ((self.view.viewpoint - vertices) * normals).sum(axis=1) > 0
        return np.asarray(facing & ~self.view.hidden(vertices))

    def free_space(self, vertices: np.ndarray, sigma: float) -> VertexQuadratic:
        """Draw vertices (V, 3) out of the space that the sensor saw to be free.

        Beside the silhouette a vertex goes towards its nearest ray, before the surface along its ray back to it, both
        with the Geman-McClure weight of width `sigma`, metres; all vertices together weigh 1, as either way of
        `attract` does.
        """
        beside, behind = self.view.compare(vertices)
        ray = vertices - self.view.viewpoint
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        across = beside - (beside * ray).sum(axis=1, keepdims=True) * ray
        inside = ~beside.any(axis=1)
        depth = np.where(inside, np.minimum(behind + self.depth_tolerance, 0.0), 0.0)
        weight = _geman_mcclure((across**2).sum(axis=1), sigma) * ~inside / len(vertices)
        weight_along = _geman_mcclure(depth**2, sigma) * (depth < 0) / len(vertices)
        outer = ray[:, :, None] * ray[:, None, :]
        return VertexQuadratic(
            weight[:, None, None] * (np.eye(3) - outer) + weight_along[:, None, None] * outer,
            weight[:, None] * across + (weight_along * depth)[:, None] * ray,
        )


def _geman_mcclure(squared: np.ndarray, sigma: float) -> np.ndarray:
    return (sigma**2 / (sigma**2 + squared)) ** 2
