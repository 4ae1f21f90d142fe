# SPDX-License-Identifier: Apache-2.0
"""Two-way correspondences between a body and a cloud, as one quadratic a vertex, and the two-way distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.evidence.cloud.nearest import NearestPoints

TANGENTIAL = 0.05
MIN_COSINE = 0.2
# Metres that a normal turned by one radian counts in the search for the closest point: the other side of a finger or of
# an arm on the hip is farther away than it seems.
TURN_LENGTH = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """A cloud to fit, seen from all around or from one place.

    Attributes:
        points: (N, 3) metres.
        normals: (N, 3) unit normals, outward.
        tree: of `points`.
        viewpoint: (3,) where the sensor stood, or None when the body was seen from all around.
    """

    points: np.ndarray
    normals: np.ndarray
    nearest: NearestPoints
    viewpoint: np.ndarray | None

    @classmethod
    def of(cls, points: np.ndarray, normals: np.ndarray, viewpoint: np.ndarray | None = None) -> Cloud:
        """Index a cloud."""
        return cls(points, normals, NearestPoints(points), viewpoint)

    def sees(self, vertices: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Which vertices (V,) face the viewpoint; all of them when there is none."""
        if self.viewpoint is None:
            return np.ones(len(vertices), dtype=bool)
        return ((self.viewpoint - vertices) * normals).sum(axis=1) > 0


@dataclass(frozen=True, slots=True, eq=False)
class VertexQuadratic:
    """sum_v (x_v - v)^T A_v (x_v - v) + 2 b_v^T (x_v - v) over vertices v, square metres.

    Attributes:
        matrix: (V, 3, 3), A.
        vector: (V, 3), b.
    """

    matrix: np.ndarray
    vector: np.ndarray


class TwoWayCorrespondence:
    """Matches both ways between a cloud and the bodies of one fit."""

    def __init__(self, cloud: Cloud, most: int | None = None) -> None:
        """Prepare a cloud; of more than `most` points only every second, third ... looks for a vertex of its own."""
        self._cloud = cloud
        self._tree = NearestPoints(cloud.points, cloud.normals, TURN_LENGTH)
        step = 1 if most is None else max(1, -(-len(cloud.points) // most))
        self._looking = np.arange(0, len(cloud.points), step)

    def attract(self, vertices: np.ndarray, faces: np.ndarray, sigma: float) -> VertexQuadratic:
        """Match both ways and return what draws the vertices to the cloud.

        Every vertex that the sensor sees goes to its closest cloud point, every cloud point to its closest vertex,
        where opposite normals count as 6 cm more; pairs whose normals disagree are dropped. A pair costs its distance
        along the cloud's normal, squared, plus 0.05 of its squared length, times the Geman-McClure weight
        (sigma^2 / (sigma^2 + d^2))^2. Either way weighs 1 in all.

        Args:
            vertices: (V, 3) metres.
            faces: (F, 3), outward.
            sigma: width of the robust kernel, metres.
        """
        cloud, looking = self._cloud, self._looking
        normals = vertex_normals(vertices, faces)
        seen = np.flatnonzero(cloud.sees(vertices, normals))
        there = self._tree.query(vertices[seen], normals[seen])[1]
        back = NearestPoints(vertices, normals, TURN_LENGTH).query(cloud.points[looking], cloud.normals[looking])[1]
        matrix, vector = np.zeros((len(vertices), 3, 3)), np.zeros((len(vertices), 3))
        for vertex, point in ((seen, there), (back, looking)):
            _add_pairs(
                vertex, point, vertices, normals, cloud.points, cloud.normals, sigma**2, 1 / max(len(point), 1),
                matrix, vector,
            )  # fmt: skip
        return VertexQuadratic(matrix, vector)

    def nearest(self, vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """How far vertices (V, 3) and cloud are apart where opposite normals count as 6 cm more.

        Returns:
            Distances (V,) to the cloud, and for every looking cloud point its nearest vertex and the distance to it.
        """
        normals, looking = vertex_normals(vertices, faces), self._looking
        body = NearestPoints(vertices, normals, TURN_LENGTH)
        back, vertex = body.query(self._cloud.points[looking], self._cloud.normals[looking])
        return self._tree.query(vertices, normals)[0], vertex, back


@njit(cache=True, nogil=True)
def _add_pairs(  # type: ignore[no-untyped-def]
    vertex, point, vertices, normals, points, point_normals, squared_width, share, matrix, vector
):
    gap = np.empty(3)
    for k in range(len(vertex)):
        v, p = vertex[k], point[k]
        cosine, along, squared = 0.0, 0.0, 0.0
        for i in range(3):
            gap[i] = vertices[v, i] - points[p, i]
            cosine += normals[v, i] * point_normals[p, i]
            along += gap[i] * point_normals[p, i]
            squared += gap[i] ** 2
        if cosine <= MIN_COSINE:
            continue
        weight = share * (squared_width / (squared_width + squared)) ** 2
        for i in range(3):
            vector[v, i] += weight * (along * point_normals[p, i] + TANGENTIAL * gap[i])
            matrix[v, i, i] += weight * TANGENTIAL
            for j in range(3):
                matrix[v, i, j] += weight * point_normals[p, i] * point_normals[p, j]


def two_way_distance(vertices: np.ndarray, faces: np.ndarray, cloud: Cloud) -> float:
    """Mean distance in metres, over both ways, between the body's surface points and the cloud.

    The surface is taken at vertices and face centres; of a one-sided cloud only the points that face the sensor.
    """
    normals = vertex_normals(vertices, faces)
    corners = vertices[faces]
    surface = np.concatenate([vertices, corners.mean(axis=1)])
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    seen = cloud.sees(surface, np.concatenate([normals, face_normals]))
    there = cloud.nearest.query(surface[seen])[0].mean() if seen.any() else np.inf
    back = NearestPoints(surface).query(cloud.points)[0].mean()
    return float((there + back) / 2)
