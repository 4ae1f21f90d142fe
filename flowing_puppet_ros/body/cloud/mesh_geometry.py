# SPDX-License-Identifier: Apache-2.0
"""Geometry of meshes and point sets that several rooms share."""

from __future__ import annotations

import numpy as np
from numba import njit


def farthest_points(points: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of `count` of `points` (N, 3), or of all, each the farthest from those before it."""
    return np.asarray(_farthest_points(np.ascontiguousarray(points, dtype=np.float64), points.mean(axis=0), count))


@njit(cache=True, nogil=True)
def _farthest_points(points, middle, count):  # type: ignore[no-untyped-def]
    """Choose points; the first is the farthest from `middle` (3,)."""
    chosen, squared = np.empty(min(count, len(points)), np.int64), np.full(len(points), np.inf)
    x, y, z = middle[0], middle[1], middle[2]
    for k in range(len(chosen)):
        best = -1.0
        for row in range(len(points)):
            own = (points[row, 0] - x) ** 2 + (points[row, 1] - y) ** 2 + (points[row, 2] - z) ** 2
            if k <= 1 or own < squared[row]:
                squared[row] = own
            if squared[row] > best:
                best, chosen[k] = squared[row], row
        x, y, z = points[chosen[k], 0], points[chosen[k], 1], points[chosen[k], 2]
    return chosen


def sum_groups(values: np.ndarray, group: np.ndarray, count: int = 0) -> np.ndarray:
    """Return the sums (G, K) of the rows of `values` (N, K) in each group (N,) of at least `count`, G."""
    return np.stack([np.bincount(group, column, count) for column in values.T], axis=1)


def triangulate_fans(polygons: list[list[int]]) -> np.ndarray:
    """Return the triangles (F, 3) of polygons, each a fan around the polygon's first vertex."""
    triangles = [[face[0], face[k], face[k + 1]] for face in polygons for k in range(1, len(face) - 1)]
    return np.array(triangles, dtype=np.int64).reshape(-1, 3)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the area-weighted unit normals (V, 3) of a triangle mesh; zero where a vertex has no face."""
    return _vertex_normals(np.ascontiguousarray(vertices, dtype=np.float64), np.ascontiguousarray(faces))


@njit(cache=True, nogil=True)
def _vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    normals = np.zeros_like(vertices)
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for corner in range(3):
            normals[faces[face, corner], 0] += x
            normals[faces[face, corner], 1] += y
            normals[faces[face, corner], 2] += z
    for vertex in range(len(vertices)):
        x, y, z = normals[vertex, 0], normals[vertex, 1], normals[vertex, 2]
        length = np.sqrt(x * x + y * y + z * z)
        if length > 0:
            normals[vertex, 0], normals[vertex, 1], normals[vertex, 2] = x / length, y / length, z / length
    return normals
