# SPDX-License-Identifier: Apache-2.0
"""A cloud from one viewpoint: what the sensor should have seen of a body, and the space that it saw to be free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from flowing_puppet_ros.body.cloud.correspondence import Cloud, VertexQuadratic, geman_mcclure
from flowing_puppet_ros.body.cloud.normals import estimate_view_normals
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.cloud.nearest import NearestPoints
from flowing_puppet_ros.evidence.cloud.neighbours import find_neighbours
from flowing_puppet_ros.evidence.cloud.one_sided import OneSidedView, compare_point
from flowing_puppet_ros.evidence.cloud.sensor_field import SensorField

MAX_VIEW_POINTS = 4000
"""More points of one side add time and no accuracy."""
MIN_SENSOR_DISTANCE_M = 0.05
"""Distance in front of the sensor that a cloud must keep."""
MIN_DEPTH_TOLERANCE_M, TOLERANCE_PER_NOISE = 0.01, 2.5
"""Distance in front of the seen surface, at least and in multiples of the noise, at which a vertex is not yet pushed
back. Noise that counts on one side only would push the body away from the sensor."""
NOISE_NEIGHBOURS, MAX_NOISE_POINTS = 6, 1000
"""Points by which the noise is measured, with the point itself, and points at which it is measured, at most."""


@dataclass(frozen=True, slots=True, eq=False)
class SingleViewCloud(Cloud):
    """A cloud to fit that was seen from one viewpoint.

    Attributes:
        view: the cloud as its sensor saw it.
        plane_noise: median distance of the points from the planes through their neighbours, metres.
    """

    view: OneSidedView
    plane_noise: float

    @property
    def noise(self) -> float:
        """Deviation of the points along their normals, metres."""
        return self.plane_noise

    @property
    def depth_tolerance(self) -> float:
        """Distance in front of the seen surface, metres, at which a vertex is not yet pushed back."""
        return max(MIN_DEPTH_TOLERANCE_M, TOLERANCE_PER_NOISE * self.plane_noise)

    @classmethod
    def seen_from(
        cls,
        points: np.ndarray,
        normals: np.ndarray | None,
        viewpoint: np.ndarray,
        unknown: np.ndarray | None = None,
        field: SensorField | None = None,
    ) -> SingleViewCloud:
        """Index a cloud; the arguments are those of `Cloud`, `unknown` that of `OneSidedView.build`.

        Without `normals` they are estimated.

        Raises:
            InputError: when part of the cloud lies behind the sensor.
        """
        forward = points.mean(axis=0) - viewpoint
        if ((points - viewpoint) @ forward <= MIN_SENSOR_DISTANCE_M * np.linalg.norm(forward)).any():
            raise InputError(
                f"the sensor at {np.round(viewpoint, 2).tolist()} m stands within the cloud and cannot have seen one"
                " side of it; check the frame or fit it as a whole cloud"
            )
        view = OneSidedView.build(points, viewpoint, unknown, field)
        if normals is None:
            normals = estimate_view_normals(points, viewpoint, view.stretch)
        every = 1 + len(points) // MAX_NOISE_POINTS
        near, own = find_neighbours(points, NOISE_NEIGHBOURS, every), np.arange(0, len(points), every)
        apart = np.abs(((points[near] - points[own, None]) * normals[own, None]).sum(axis=2))
        noise = float(np.median(apart[near != own[:, None]]))
        return cls(points, normals, NearestPoints(points), viewpoint, field, view, noise)

    def sees(self, vertices: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return which vertices (V,) face the sensor, are in its field and not hidden by what it saw."""
        return self.view.find_seen(vertices, normals)

    def free_space_term(self, vertices: np.ndarray, sigma: float) -> VertexQuadratic:
        """Return the quadratic that pulls vertices (V, 3) out of the space that the sensor saw to be free.

        A vertex beside the silhouette moves towards its nearest ray, one in front of the surface along its own ray
        back to it, both with the `geman_mcclure` weight of width `sigma` in metres. The total weight is 1, as in each
        direction of `attract`.
        """
        return VertexQuadratic(*_pull_to_seen(vertices, self.view.arrays, self.depth_tolerance, sigma**2))


@njit(cache=True, nogil=True)
def _pull_to_seen(vertices, view, tolerance, squared_width):  # type: ignore[no-untyped-def]
    """Return the matrices (V, 3, 3) and vectors (V, 3) that pull vertices out of free space."""
    viewpoint, axes = view[0], view[1]
    matrix, vector = np.zeros((len(vertices), 3, 3)), np.zeros_like(vertices)
    ray, across = np.empty(3), np.empty(3)
    for k in range(len(vertices)):
        dx, dy, behind = compare_point(vertices[k, 0], vertices[k, 1], vertices[k, 2], view)
        aside = dx != 0 or dy != 0
        depth = behind + tolerance
        if not aside and depth >= 0:
            continue
        for i in range(3):
            ray[i] = vertices[k, i] - viewpoint[i]
        ray /= np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
        if aside:
            along, squared = 0.0, 0.0
            for i in range(3):
                across[i] = dx * axes[0, i] + dy * axes[1, i]
                along += across[i] * ray[i]
            for i in range(3):
                across[i] -= along * ray[i]
                squared += across[i] ** 2
            weight = geman_mcclure(squared, squared_width) / len(vertices)
            for i in range(3):
                vector[k, i] = weight * across[i]
                for j in range(3):
                    matrix[k, i, j] = -weight * ray[i] * ray[j]
                matrix[k, i, i] += weight
        else:
            weight = geman_mcclure(depth**2, squared_width) / len(vertices)
            for i in range(3):
                vector[k, i] = weight * depth * ray[i]
                for j in range(3):
                    matrix[k, i, j] = weight * ray[i] * ray[j]
    return matrix, vector
