# SPDX-License-Identifier: Apache-2.0
"""Exact nearest points for bodies that lie on clouds: a grid of the points, and a k-d tree for queries far from them.

A body being fitted lies within centimetres of its cloud, so the nearest point is in one of a few cells. Searching them
takes a fraction of the time of a k-d tree, above all for the many indices that are built for one step's vertices.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

CELL_SPACINGS = 2.5
"""Cell edge, in mean spacings of points on a surface as wide as the points are."""
MAX_CELLS = 300_000  # of the grid's bounding box; larger boxes get larger cells
MAX_RINGS = 4
"""Rings of cells around a query that are searched before the k-d tree is used."""


class NearestPoints:
    """An index of `points` (N, 3) m, N > 0, and, for searches that also compare directions, of unit `normals` (N, 3).

    `turn_length` is the distance in metres for which an angle of one radian between normals counts: the distance of a
    query's (x, n) to a point's (y, m) is sqrt(|x - y|^2 + turn_length^2 |n - m|^2).
    """

    def __init__(self, points: np.ndarray, normals: np.ndarray | None = None, turn_length: float = 0.0) -> None:
        self.points = np.ascontiguousarray(points, dtype=np.float64)
        self._turn_length = turn_length
        self._scaled_normals = np.empty((0, 3)) if normals is None else np.ascontiguousarray(turn_length * normals)
        low, high = find_bounds(self.points)
        cell = CELL_SPACINGS * float((high - low).max()) / np.sqrt(len(points))
        cell = max(cell, float(np.prod((high - low) / MAX_CELLS ** (1 / 3))) ** (1 / 3), 1e-9)
        shape = np.floor((high - low) / cell).astype(np.int64) + 1
        rows, start = sort_by_cell(self.points, low, cell, shape)
        sorted_normals = _take_rows(self._scaled_normals, rows) if len(self._scaled_normals) else self._scaled_normals
        self._grid = (low, cell, shape, rows, start, _take_rows(self.points, rows), sorted_normals)
        self._tree: cKDTree | None = None

    def query(
        self, points: np.ndarray, normals: np.ndarray | None = None, guess: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the distance (M,) from each of `points` (M, 3) to the nearest indexed point, and its index (M,).

        `normals` (M, 3) are the unit normals of `points`, for an index that has normals. `guess` (M,) are indices of
        points that are near, such as the nearest ones a moment before: the answer is the same, in less time.
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        scaled_normals = np.empty((0, 3)) if normals is None else np.ascontiguousarray(self._turn_length * normals)
        first = np.empty(0, dtype=np.int64) if guess is None else guess
        distance, index = _nearest(points, scaled_normals, first, (self.points, self._scaled_normals), *self._grid)
        far = np.flatnonzero(index < 0)
        if len(far):
            if self._tree is None:
                self._tree = cKDTree(_stack_normals(self.points, self._scaled_normals))
            distance[far], index[far] = self._tree.query(_stack_normals(points, scaled_normals)[far])
        return distance, index


def find_beside(points: np.ndarray, others: np.ndarray, max_distance: float) -> np.ndarray:
    """Return which of `points` (N, 3) m are nearer than `max_distance` to any of `others` (M, 3), M > 0."""
    low, high = others.min(axis=0) - max_distance, others.max(axis=0) + max_distance
    beside = ((points > low) & (points < high)).all(axis=1)
    beside[beside] = NearestPoints(others).query(points[beside])[0] < max_distance
    return beside


def _stack_normals(points: np.ndarray, scaled_normals: np.ndarray) -> np.ndarray:
    return np.hstack([points, scaled_normals]) if len(scaled_normals) else points


@njit(cache=True, nogil=True)
def find_bounds(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and the largest coordinates (3,) of points (N, 3), much faster than along NumPy's axis 0."""
    low, high = points[0].copy(), points[0].copy()
    for row in range(1, len(points)):
        for axis in range(3):
            low[axis] = min(low[axis], points[row, axis])
            high[axis] = max(high[axis], points[row, axis])
    return low, high


@njit(cache=True, nogil=True)
def sort_by_cell(points: np.ndarray, low: np.ndarray, cell: float, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows (N,) of the points, sorted by cell, and where each cell's begin (cells + 1,)."""
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
def _take_rows(points: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return `points` (N, 3) in the order of `rows` (N,), in a fifth of NumPy's time."""
    taken = np.empty((len(rows), 3))
    for place in range(len(rows)):
        for axis in range(3):
            taken[place, axis] = points[rows[place], axis]
    return taken


@njit(cache=True, nogil=True)
def _nearest(  # type: ignore[no-untyped-def]
    queries, query_normals, guess, unsorted, low, cell, shape, rows, start, points, normals
):
    """Return distance and row of the point nearest to each query; row -1 where no point is in the rings around it.

    `points` and `normals` (scaled, or none) are in the order of the cells, as `rows` is; `unsorted` are the same in the
    order of the rows. `guess` are rows, one for each query, or none.

    Rings of cells are searched until a point is nearer than they reach, which a guess mostly is from the beginning;
    then all cells are that reach into the sphere up to that point. Cells along z follow each other, so that those of a
    column are searched in one loop.
    """
    count, use_normals = len(queries), len(normals) > 0
    distance, index = np.empty(count), np.empty(count, np.int64)
    nx, ny, nz = shape[0], shape[1], shape[2]
    u, v, w = 0.0, 0.0, 0.0
    for query in range(count):
        x, y, z = queries[query, 0], queries[query, 1], queries[query, 2]
        if use_normals:
            u, v, w = query_normals[query, 0], query_normals[query, 1], query_normals[query, 2]
        best, found = np.inf, -1
        if len(guess):
            row = guess[query]
            best, found = _squared_distance(x, y, z, unsorted[0], row), row
            if use_normals:
                best += _squared_distance(u, v, w, unsorted[1], row)
        a, b, c = _cell_of(x, low[0], cell, nx), _cell_of(y, low[1], cell, ny), _cell_of(z, low[2], cell, nz)
        reach = 0
        while reach <= MAX_RINGS and best > (cell * reach) ** 2:
            for i in range(max(a - reach, 0), min(a + reach, nx - 1) + 1):
                for j in range(max(b - reach, 0), min(b + reach, ny - 1) + 1):
                    # On the ring's rim the whole column is new, inside of it only the two ends.
                    step = 1 if abs(i - a) == reach or abs(j - b) == reach else 2 * reach
                    for k in range(c - reach, c + reach + 1, max(step, 1)):
                        if not 0 <= k < nz:
                            continue
                        flat = (i * ny + j) * nz + k
                        for place in range(start[flat], start[flat + 1]):
                            squared = _squared_distance(x, y, z, points, place)
                            if use_normals and squared < best:
                                squared += _squared_distance(u, v, w, normals, place)
                            if squared < best:
                                best, found = squared, rows[place]
            reach += 1
        if best > (cell * MAX_RINGS) ** 2:
            distance[query], index[query] = best, -1
            continue
        radius = np.sqrt(best)
        first, last = _cell_of(z - radius, low[2], cell, nz), _cell_of(z + radius, low[2], cell, nz)
        for i in range(_cell_of(x - radius, low[0], cell, nx), _cell_of(x + radius, low[0], cell, nx) + 1):
            across_x = _outside(x, low[0] + cell * i, cell)
            for j in range(_cell_of(y - radius, low[1], cell, ny), _cell_of(y + radius, low[1], cell, ny) + 1):
                if across_x + _outside(y, low[1] + cell * j, cell) >= best:
                    continue
                column = (i * ny + j) * nz
                for place in range(start[column + first], start[column + last + 1]):
                    squared = _squared_distance(x, y, z, points, place)
                    if use_normals and squared < best:
                        squared += _squared_distance(u, v, w, normals, place)
                    if squared < best:
                        best, found = squared, rows[place]
        distance[query], index[query] = np.sqrt(best), found
    return distance, index


@njit(cache=True, inline="always")
def _squared_distance(x: float, y: float, z: float, points: np.ndarray, row: int) -> float:
    return (x - points[row, 0]) ** 2 + (y - points[row, 1]) ** 2 + (z - points[row, 2]) ** 2


@njit(cache=True, inline="always")
def _cell_of(x: float, low: float, cell: float, count: int) -> int:
    """Return the number of the cell along one axis, clamped to the grid."""
    return int(min(max((x - low) / cell, 0.0), count - 1.0))


@njit(cache=True, inline="always")
def gap_beyond_rings(x: float, low: float, cell: float, count: int, home: int, ring: int) -> float:
    """Return the distance along one axis to the cells beyond the rings so far; infinite where there are none."""
    gap = np.inf
    if home - ring > 0:
        gap = min(gap, x - (low + cell * (home - ring)))
    if home + ring < count - 1:
        gap = min(gap, low + cell * (home + ring + 1) - x)
    return gap


@njit(cache=True, inline="always")
def _outside(x: float, start: float, cell: float) -> float:
    """Return the squared distance along one axis to a cell, 0 inside of it."""
    gap = max(start - x, x - start - cell, 0.0)
    return gap * gap
