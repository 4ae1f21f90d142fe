# SPDX-License-Identifier: Apache-2.0
"""Small geometry of meshes and point sets."""

from __future__ import annotations

import numpy as np


def farthest_points(points: np.ndarray, count: int) -> np.ndarray:
    """Return indices of `count` points (or all) of (N, 3) `points`, each the farthest from those before it."""
    chosen = np.empty(min(count, len(points)), dtype=np.int64)
    distance = np.linalg.norm(points - points.mean(axis=0), axis=1)
    for turn in range(len(chosen)):
        chosen[turn] = distance.argmax()
        if turn == 0:
            distance = np.full(len(points), np.inf)
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[turn]], axis=1))
    return chosen


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted unit normals (V, 3) of a triangle mesh; zero where a vertex has no face."""
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for axis in range(3):
        for corner in range(3):
            normals[:, axis] += np.bincount(faces[:, corner], cross[:, axis], minlength=len(vertices))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0, length, 1)
