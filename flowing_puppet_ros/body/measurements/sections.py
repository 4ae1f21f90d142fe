# SPDX-License-Identifier: Apache-2.0
"""Horizontal sections of a closed mesh: loops, their girths, the levels at which limbs part from the trunk."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from flowing_puppet_ros.arrays import F64, Array

MIN_GIRTH_M = 0.1
"""Girth of a loop below which it is no limb: a finger, a fold."""
_BISECTIONS = 12


class Sections:
    """The horizontal sections of a body (V, 3) with faces (F, 3), metres, z up."""

    def __init__(self, vertices: Array, faces: Array) -> None:
        """Find the edges of the mesh."""
        self.vertices = np.asarray(vertices, np.float64)
        corners = np.asarray(faces, np.int64)
        edges = np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        self._edges, edge_of_side = np.unique(edges, axis=0, return_inverse=True)
        self._sides = edge_of_side.reshape(-1, 3)

    def loops(self, level: float) -> list[F64]:
        """Return the points (N, 2) of each connected loop of the section at a level, those of limbs and trunk only."""
        height = self.vertices[:, 2] - level
        ends = height[self._edges]
        crossed = (ends[:, 0] > 0) != (ends[:, 1] > 0)
        ids = np.flatnonzero(crossed)
        if len(ids) < 3:
            return []
        low, high = self.vertices[self._edges[ids, 0]], self.vertices[self._edges[ids, 1]]
        share = (ends[ids, 0] / (ends[ids, 0] - ends[ids, 1]))[:, None]
        points = (low + share * (high - low))[:, :2]
        number = np.full(len(self._edges), -1)
        number[ids] = np.arange(len(ids))
        cut = number[self._sides[crossed[self._sides].sum(axis=1) == 2]]
        pairs = cut[cut >= 0].reshape(-1, 2)
        graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (len(ids), len(ids)))
        count, label = connected_components(graph, directed=False)
        found = [points[label == k] for k in range(count)]
        return [loop for loop in found if girth(loop) > MIN_GIRTH_M]

    def trunk_girth(self, level: float) -> float:
        """Return the girth of the largest loop at a level, 0 where there is none."""
        return max((girth(loop) for loop in self.loops(level)), default=0.0)

    def find_level(self, low: float, high: float, is_below: Callable[[list[F64]], bool]) -> float:
        """Return the level between two at which `is_below` of the loops changes from true to false."""
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            if is_below(self.loops(middle)):
                low = middle
            else:
                high = middle
        return (low + high) / 2


def girth(points: Array) -> float:
    """Return the length of a tape around points (N, 2): the perimeter of their convex hull."""
    if len(points) < 3:
        return 0.0
    try:
        return float(ConvexHull(points).area)  # in the plane, Qhull's area is the perimeter
    except QhullError:
        return 0.0


def signed_volume(vertices: Array, faces: Array) -> float:
    """Return the volume inside a closed mesh whose faces are counter-clockwise from outside."""
    a, b, c = (np.asarray(vertices, np.float64)[faces[:, k]] for k in range(3))
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)
