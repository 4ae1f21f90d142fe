# SPDX-License-Identifier: Apache-2.0
"""Exact nearest points for bodies that lie on clouds: a grid of the points, and a k-d tree where that is far from them.

A body that is fitted lies within centimetres of its cloud, so that the points of a few cells hold the nearest one. That
takes a fraction of the time of a k-d tree, most of all for the many indices that are built for one step's vertices.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

CELL_SHARE = 1.5
"""Cell edge in mean spacings of points on a surface as wide as the points are."""
MAX_CELLS = 300_000
RINGS = 4
"""Cells around a place that are searched before the k-d tree is asked."""


class NearestPoints:
    """An index of points (N, 3) in metres, N > 0, and, for searches that heed directions, of unit normals (N, 3).

    `turn_length` is how many metres a normal turned by one radian counts: the distance of a query's (x, n) to a point's
    (y, m) is sqrt(|x - y|^2 + turn_length^2 |n - m|^2).
    """

    def __init__(self, points: np.ndarray, normals: np.ndarray | None = None, turn_length: float = 0.0) -> None:
        self.points = np.ascontiguousarray(points, dtype=np.float64)
        self._turn_length = turn_length
        self._turned = np.empty((0, 3)) if normals is None else np.ascontiguousarray(turn_length * normals)
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        cell = CELL_SHARE * float((high - low).max()) / np.sqrt(len(points))
        cell = max(cell, float(np.prod((high - low) / MAX_CELLS ** (1 / 3))) ** (1 / 3), 1e-9)
        shape = np.floor((high - low) / cell).astype(np.int64) + 1
        rows, start = _sorted_by_cell(self.points, low, cell, shape)
        turned = self._turned[rows] if len(self._turned) else self._turned
        self._grid = (low, cell, shape, rows, start, self.points[rows], turned)
        self._tree: cKDTree | None = None

    def query(self, points: np.ndarray, normals: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the distance (M,) to the nearest point of each of `points` (M, 3), and its index (M,).

        normals: (M, 3) unit normals of `points`, for an index that has normals.
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        turned = np.empty((0, 3)) if normals is None else np.ascontiguousarray(self._turn_length * normals)
        distance, index = _nearest(points, turned, *self._grid)
        far = np.flatnonzero(index < 0)
        if len(far):
            if self._tree is None:
                self._tree = cKDTree(_placed(self.points, self._turned))
            distance[far], index[far] = self._tree.query(_placed(points, turned)[far])
        return distance, index


def _placed(points: np.ndarray, turned: np.ndarray) -> np.ndarray:
    return np.hstack([points, turned]) if len(turned) else points


@njit(cache=True, nogil=True)
def _sorted_by_cell(
    points: np.ndarray, low: np.ndarray, cell: float, shape: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (N,) of the points by the number of their cell, and where each cell's begin (cells + 1,)."""
    number = np.empty(len(points), np.int64)
    start = np.zeros(shape[0] * shape[1] * shape[2] + 1, np.int64)
    for row in range(len(points)):
        flat = 0
        for axis in range(3):
            flat = flat * shape[axis] + min(int((points[row, axis] - low[axis]) / cell), shape[axis] - 1)
        number[row] = flat
        start[flat + 1] += 1
    for flat in range(1, len(start)):
        start[flat] += start[flat - 1]
    rows, filled = np.empty(len(points), np.int64), start[:-1].copy()
    for row in range(len(points)):
        rows[filled[number[row]]] = row
        filled[number[row]] += 1
    return rows, start


@njit(cache=True, nogil=True)
def _nearest(  # type: ignore[no-untyped-def]
    queries, turned_queries, low, cell, shape, rows, start, points, turned
):
    """Distance and row of the point nearest to each query; row -1 where the cells around it do not settle it.

    `points` and `turned` (normals times their length, or none) are in the order of the cells, as `rows` is.
    """
    count, use_turned = len(queries), len(turned) > 0
    distance, index = np.empty(count), np.empty(count, np.int64)
    nx, ny, nz = shape[0], shape[1], shape[2]
    u, v, w = 0.0, 0.0, 0.0
    for query in range(count):
        x, y, z = queries[query, 0], queries[query, 1], queries[query, 2]
        if use_turned:
            u, v, w = turned_queries[query, 0], turned_queries[query, 1], turned_queries[query, 2]
        a, b, c = _cell_of(x, low[0], cell, nx), _cell_of(y, low[1], cell, ny), _cell_of(z, low[2], cell, nz)
        best, found = np.inf, -1
        for ring in range(RINGS + 1):
            for i in range(max(a - ring, 0), min(a + ring, nx - 1) + 1):
                for j in range(max(b - ring, 0), min(b + ring, ny - 1) + 1):
                    # On the rim all of the column is new, inside of it only its two ends.
                    step = 1 if abs(i - a) == ring or abs(j - b) == ring else 2 * ring
                    for k in range(c - ring, c + ring + 1, step):
                        if not 0 <= k < nz:
                            continue
                        flat = (i * ny + j) * nz + k
                        for place in range(start[flat], start[flat + 1]):
                            squared = (
                                (x - points[place, 0]) ** 2 + (y - points[place, 1]) ** 2 + (z - points[place, 2]) ** 2
                            )
                            if use_turned and squared < best:
                                squared += (
                                    (u - turned[place, 0]) ** 2
                                    + (v - turned[place, 1]) ** 2
                                    + (w - turned[place, 2]) ** 2
                                )
                            if squared < best:
                                best, found = squared, place
            gap = min(
                _gap(x, low[0], cell, nx, a, ring), _gap(y, low[1], cell, ny, b, ring),
                _gap(z, low[2], cell, nz, c, ring),
            )  # fmt: skip
            if best <= gap * abs(gap):
                break
        else:
            found = -1
        distance[query], index[query] = np.sqrt(best), rows[found] if found >= 0 else -1
    return distance, index


@njit(cache=True, inline="always")
def _cell_of(x: float, low: float, cell: float, count: int) -> int:
    """Number of the cell along one axis, clamped to the grid."""
    return int(min(max((x - low) / cell, 0.0), count - 1.0))


@njit(cache=True, inline="always")
def _gap(x: float, low: float, cell: float, count: int, home: int, ring: int) -> float:
    """How far beyond the cells of the rings so far begins, along one axis; infinite where nothing is beyond."""
    gap = np.inf
    if home - ring > 0:
        gap = min(gap, x - (low + cell * (home - ring)))
    if home + ring < count - 1:
        gap = min(gap, low + cell * (home + ring + 1) - x)
    return gap
