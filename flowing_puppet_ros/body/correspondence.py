# SPDX-License-Identifier: Apache-2.0
"""Two-way correspondences between a body and a cloud, as one quadratic a vertex, and the two-way distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from flowing_puppet_ros.body.geometry import vertex_normals

TANGENTIAL = 0.05
MIN_COSINE = 0.2


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
    tree: cKDTree
    viewpoint: np.ndarray | None

    @classmethod
    def of(cls, points: np.ndarray, normals: np.ndarray, viewpoint: np.ndarray | None = None) -> Cloud:
        """Index a cloud."""
        return cls(points, normals, cKDTree(points), viewpoint)

    def sees(self, vertices: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Which vertices (V,) face the viewpoint; all of them when there is none."""
        if self.viewpoint is None:
            return np.ones(len(vertices), dtype=bool)
        return ((self.viewpoint - vertices) * normals).sum(axis=1) > 0


@dataclass(frozen=True, slots=True, eq=False)
class Quadratic:
    """sum_v (x_v - v)^T A_v (x_v - v) + 2 b_v^T (x_v - v) over vertices v, square metres.

    Attributes:
        matrix: (V, 3, 3), A.
        vector: (V, 3), b.
    """

    matrix: np.ndarray
    vector: np.ndarray


def attract(vertices: np.ndarray, faces: np.ndarray, cloud: Cloud, sigma: float) -> Quadratic:
    """Match both ways and return what draws the vertices to the cloud.

    Every vertex that the sensor sees goes to its closest cloud point, every cloud point to its closest vertex; pairs
    whose normals disagree are dropped. A pair costs its distance along the cloud's normal, squared, plus 0.05 of its
    squared length, times the Geman-McClure weight (sigma^2 / (sigma^2 + d^2))^2. Either way weighs 1 in all.

    Args:
        vertices: (V, 3) metres.
        faces: (F, 3), outward.
        cloud: what to fit.
        sigma: width of the robust kernel, metres.
    """
    normals = vertex_normals(vertices, faces)
    distance, index = cloud.tree.query(vertices)
    seen = cloud.sees(vertices, normals)
    pairs = _pairs(np.arange(len(vertices)), index, distance, seen, normals, cloud, sigma, max(int(seen.sum()), 1))
    back_distance, back_index = cKDTree(vertices).query(cloud.points)
    everything = np.ones(len(cloud.points), dtype=bool)
    rows = np.arange(len(cloud.points))
    back = _pairs(back_index, rows, back_distance, everything, normals, cloud, sigma, len(cloud.points))
    vertex, point, weight = (np.concatenate(both) for both in zip(pairs, back, strict=True))
    normal = cloud.normals[point]
    gap = vertices[vertex] - cloud.points[point]
    along = weight * (normal * gap).sum(axis=1)
    vector = along[:, None] * normal + (TANGENTIAL * weight)[:, None] * gap
    matrix = weight[:, None, None] * (normal[:, :, None] * normal[:, None, :] + TANGENTIAL * np.eye(3))
    return Quadratic(
        _sum_rows(vertex, matrix.reshape(-1, 9), len(vertices)).reshape(-1, 3, 3),
        _sum_rows(vertex, vector, len(vertices)),
    )


def _pairs(
    vertex: np.ndarray,
    point: np.ndarray,
    distance: np.ndarray,
    allowed: np.ndarray,
    normals: np.ndarray,
    cloud: Cloud,
    sigma: float,
    count: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertex, cloud point and weight of the pairs that pass the normal gate."""
    cosine = (normals[vertex] * cloud.normals[point]).sum(axis=1)
    kept = allowed & (cosine > MIN_COSINE)
    weight = (sigma**2 / (sigma**2 + distance[kept] ** 2)) ** 2 / count
    return vertex[kept], point[kept], weight


def _sum_rows(group: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    return np.stack([np.bincount(group, column, minlength=count) for column in values.T], axis=1)


def two_way_distance(vertices: np.ndarray, faces: np.ndarray, cloud: Cloud) -> float:
    """Mean distance in metres, over both ways, between the body's surface points and the cloud.

    The surface is taken at vertices and face centres; of a one-sided cloud only the points that face the sensor.
    """
    normals = vertex_normals(vertices, faces)
    corners = vertices[faces]
    surface = np.concatenate([vertices, corners.mean(axis=1)])
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    seen = cloud.sees(surface, np.concatenate([normals, face_normals]))
    there = cloud.tree.query(surface[seen])[0].mean() if seen.any() else np.inf
    back = cKDTree(surface).query(cloud.points)[0].mean()
    return float((there + back) / 2)
