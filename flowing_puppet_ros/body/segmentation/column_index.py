# SPDX-License-Identifier: Apache-2.0
"""The points of a scene by the cell of the floor that they are over, so that those near a place are found at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

CELL_M, MAX_CELLS = 0.5, 2000  # edge of a cell; cells a side, so that the last ones hold whatever lies beyond

MEDIAN_POINTS = 5000  # of a scan, whose median is its middle
WALL_CELL_M, WALL_BANDS_M = 0.05, (1.85, 2.15, 2.5)
"""Edge of a cell in which walls are looked for, and heights over the floor between which a wall, a post or a machine
goes on: nobody fills both bands, and a lamp or a ceiling only the upper one."""


@dataclass(frozen=True, slots=True, eq=False)
class ColumnIndex:
    """Where the points of each cell are.

    Attributes:
        order: (N,) indices of the points by cell, ascending in each.
        first: (W D + 1,) of each cell in `order`.
        low: (2,) metres, corner of the first cell.
        shape: (2,) number of cells along x and y.
    """

    order: np.ndarray
    first: np.ndarray
    low: np.ndarray
    shape: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray) -> ColumnIndex:
        """Sort points (N, 3) m, N > 0, into cells."""
        low, shape, _ = lay_grid(points, CELL_M, MAX_CELLS)
        order, first = sort_into_cells(points, low, shape, CELL_M)
        return cls(order, first, low, shape)

    def find_near(self, points: np.ndarray, place: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the indices (K,) of the points (N, 3) m within `radius` of a place (2,) m, and how far they are."""
        rows, away = _find_near(points, self.order, self.first, self.low, self.shape, place[0], place[1], radius)
        return rows, away


def find_walls(points: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Return which (N,) of the points (N, 3) m, N > 0, with a `height` (N,) over the floor go on above all heads."""
    low, shape, _ = lay_grid(points, WALL_CELL_M, int(MAX_CELLS * CELL_M / WALL_CELL_M / 10))
    return np.asarray(_find_walls(points, height, low, shape[0], shape[1]))


@njit(cache=True, nogil=True)
def _find_walls(points, height, low, wide, deep):  # type: ignore[no-untyped-def]
    """Mark the cells of both bands, and those beside them, and look the points up."""
    bands = np.zeros((2, wide, deep), np.bool_)
    for row in range(len(points)):
        band = -1 if height[row] <= WALL_BANDS_M[0] else 0 if height[row] <= WALL_BANDS_M[1] else 1
        if band < 0 or height[row] > WALL_BANDS_M[2]:
            continue
        i = int(np.floor((points[row, 0] - low[0]) / WALL_CELL_M))
        j = int(np.floor((points[row, 1] - low[1]) / WALL_CELL_M))
        for a in range(max(i - 1, 0), min(i + 2, wide)):
            for b in range(max(j - 1, 0), min(j + 2, deep)):
                bands[band, a, b] = True
    found = np.zeros(len(points), np.bool_)
    for row in range(len(points)):
        i = int(np.floor((points[row, 0] - low[0]) / WALL_CELL_M))
        j = int(np.floor((points[row, 1] - low[1]) / WALL_CELL_M))
        if 0 <= i < wide and 0 <= j < deep:
            found[row] = bands[0, i, j] and bands[1, i, j]
    return found


def lay_grid(points: np.ndarray, width: float, max_cells: int) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return the corner (2,) m of a grid over points (N, 3) m, N > 0, its size (2,), and whether all lie in it.

    It has at most `max_cells` cells of a `width` m a side; where that is not enough, about the middle of the points.
    """
    least, most = _find_extent(points)
    middle = np.median(points[:: 1 + len(points) // MEDIAN_POINTS, :2], axis=0)
    low = np.maximum(least, middle - width * max_cells / 2)
    wanted = ((most - low) / width).astype(np.int64) + 1
    return low, np.minimum(wanted, max_cells), bool((low <= least).all() and (wanted <= max_cells).all())


@njit(cache=True, nogil=True)
def _find_extent(points):  # type: ignore[no-untyped-def]
    least, most = np.full(2, np.inf), np.full(2, -np.inf)
    for row in range(len(points)):
        for axis in range(2):
            least[axis], most[axis] = min(least[axis], points[row, axis]), max(most[axis], points[row, axis])
    return least, most


@njit(cache=True, nogil=True)
def sort_into_cells(points, low, shape, width):  # type: ignore[no-untyped-def]
    """Return the indices of points (N, 3) by their cell, clamped to the grid, and where each cell's begin."""
    wide, deep = shape[0], shape[1]
    cell = np.empty(len(points), np.int64)
    first = np.zeros(wide * deep + 1, np.int64)
    for row in range(len(points)):
        i = min(max(int(np.floor((points[row, 0] - low[0]) / width)), 0), wide - 1)
        j = min(max(int(np.floor((points[row, 1] - low[1]) / width)), 0), deep - 1)
        cell[row] = i * deep + j
        first[cell[row] + 1] += 1
    first = np.cumsum(first)
    place = first[:-1].copy()
    order = np.empty(len(points), np.int64)
    for row in range(len(points)):
        order[place[cell[row]]] = row
        place[cell[row]] += 1
    return order, first


@njit(cache=True, nogil=True)
def _find_near(points, order, first, low, shape, x, y, radius):  # type: ignore[no-untyped-def]
    i0 = min(max(int(np.floor((x - radius - low[0]) / CELL_M)), 0), shape[0] - 1)
    i1 = min(max(int(np.floor((x + radius - low[0]) / CELL_M)), 0), shape[0] - 1)
    j0 = min(max(int(np.floor((y - radius - low[1]) / CELL_M)), 0), shape[1] - 1)
    j1 = min(max(int(np.floor((y + radius - low[1]) / CELL_M)), 0), shape[1] - 1)
    room = 0
    for i in range(i0, i1 + 1):
        room += first[i * shape[1] + j1 + 1] - first[i * shape[1] + j0]
    rows, away, count = np.empty(room, np.int64), np.empty(room), 0
    for i in range(i0, i1 + 1):
        for k in range(first[i * shape[1] + j0], first[i * shape[1] + j1 + 1]):
            row = order[k]
            distance = np.hypot(points[row, 0] - x, points[row, 1] - y)
            if distance <= radius:
                rows[count], away[count] = row, distance
                count += 1
    return rows[:count], away[:count]
