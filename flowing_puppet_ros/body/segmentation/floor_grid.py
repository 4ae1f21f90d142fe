# SPDX-License-Identifier: Apache-2.0
"""The floor of a scene as a grid of heights: a plane, and how far pavements, ramps and thresholds differ from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.ndimage import gaussian_filter

from flowing_puppet_ros.body.segmentation.column_index import lay_grid, sort_into_cells

CELL_M, MAX_CELLS = 1.0, 200  # edge of a cell; cells a side, so that the grid ends there
LOW_SHARE = 0.03
"""Share of a cell's points that may lie below its floor: reflections and noise."""
MIN_CELL_POINTS = 3
MAX_SLOPE = 0.05  # of the floor against the plane, so that cells on furniture and cars take their neighbours' floor
MAX_BELOW_PLANE_M = 1.0  # a cell that is lower shows a reflection or a shaft
PLANE_STEPS, PLANE_WIDTH_M = 12, 0.12  # of the robust fit; above the plane, cells count less beyond this width
MAX_PLANE_SLOPE = 0.25
BLUR_CELLS = 0.7
FLOOR_THICKNESS_M, MIN_FLOOR_SHARE, MAX_CEILING_SHARE = 0.1, 0.25, 0.08
"""Distance from the floor up to which points are on it, the share of a scan's points that are on it at least, and the
share that may be on what is lowest in a scan that is upside down."""


@dataclass(frozen=True, slots=True, eq=False)
class FloorGrid:
    """Heights of the floor: `heights` (W, D) m of cells from `low` (2,) m on, bilinear between their centres."""

    heights: np.ndarray
    low: np.ndarray

    @classmethod
    def find(cls, points: np.ndarray) -> FloorGrid:
        """Find the floor of a scene with points (N, 3) m, z up, N > 0; where none is seen, its neighbours' floor."""
        low, shape, all_inside = lay_grid(points, CELL_M, MAX_CELLS)
        lowest = _find_lowest(np.ascontiguousarray(points), low, shape, all_inside)
        x, y = (low[k] + CELL_M * (np.arange(shape[k]) + 0.5) for k in (0, 1))
        plane = _fit_plane(lowest, x, y, points)
        base = plane[0] + plane[1] * x[:, None] + plane[2] * y[None, :]
        above = lowest - base
        above[np.isnan(above) | (above < -MAX_BELOW_PLANE_M)] = np.inf
        if not np.isfinite(above).any():
            above[:] = 0.0
        eroded = _limit_slope(above, MAX_SLOPE * CELL_M)
        return cls(base + gaussian_filter(eroded, BLUR_CELLS, mode="nearest"), low)

    def height(self, points: np.ndarray) -> np.ndarray:
        """Return the heights (N,) of points (N, 3) over the floor, metres."""
        return _height_over(np.ascontiguousarray(points, dtype=np.float64), self.heights, self.low)

    def locate(self, x: float, y: float) -> float:
        """Return z of the floor at a place, metres."""
        return -float(self.height(np.array([[x, y, 0.0]]))[0])


def looks_upside_down(points: np.ndarray) -> bool:
    """Return whether a scene (N, 3) m with N > 0 has its floor above everything else: its sensor hangs head first."""
    below, above = (
        float((np.abs(FloorGrid.find(each).height(each)) < FLOOR_THICKNESS_M).mean())
        for each in (points, points * np.array([1.0, 1.0, -1.0]))
    )
    return above > MIN_FLOOR_SHARE and below < MAX_CEILING_SHARE


def _find_lowest(points: np.ndarray, low: np.ndarray, shape: np.ndarray, all_inside: bool) -> np.ndarray:
    """Return a low percentile (W, D) of z in each cell, NaN where too few points are."""
    inside = points
    if not all_inside:
        beyond = (points[:, :2] < low).any(axis=1) | (points[:, :2] >= low + CELL_M * shape).any(axis=1)
        inside = points[~beyond]
    lowest = _select_lowest(inside, *sort_into_cells(inside, low, shape, CELL_M))
    return np.asarray(lowest.reshape(int(shape[0]), int(shape[1])))


@njit(cache=True, nogil=True)
def _select_lowest(points, order, first):  # type: ignore[no-untyped-def]
    lowest = np.full(len(first) - 1, np.nan)
    for cell in range(len(lowest)):
        count = first[cell + 1] - first[cell]
        if count >= MIN_CELL_POINTS:
            z = np.empty(count)
            for k in range(count):
                z[k] = points[order[first[cell] + k], 2]
            rank = int(LOW_SHARE * count)
            lowest[cell] = np.partition(z, rank)[rank]
    return lowest


def _fit_plane(lowest: np.ndarray, x: np.ndarray, y: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the plane z = a + b x + c y (3,) below the cells' lowest points: furniture above counts little."""
    rows, columns = np.nonzero(np.isfinite(lowest))
    if not len(rows):
        return np.array([np.percentile(points[:, 2], 100 * LOW_SHARE), 0.0, 0.0])
    z = lowest[rows, columns]
    middle = np.array([x[rows].mean(), y[columns].mean()])
    table = np.stack([np.ones(len(z)), x[rows] - middle[0], y[columns] - middle[1]], axis=1)
    plane = np.array([np.percentile(z, 20), 0.0, 0.0])
    # Flat at first: a slope only once the level is known. The ridge keeps few cells from tilting it.
    for step in range(PLANE_STEPS):
        gap = z - table @ plane
        width = PLANE_WIDTH_M * (4 if step < PLANE_STEPS // 2 else 1)
        weight = 1 / (1 + np.where(gap > 0, gap / width, gap / MAX_BELOW_PLANE_M) ** 2) ** 2
        ridge = np.diag([1e-9, 20.0, 20.0])
        plane = np.linalg.solve((table * weight[:, None]).T @ table + ridge, (table * weight[:, None]).T @ z)
    slope = np.clip(plane[1:], -MAX_PLANE_SLOPE, MAX_PLANE_SLOPE)
    return np.array([plane[0] - slope @ middle, *slope])


@njit(cache=True, nogil=True)
def _limit_slope(heights: np.ndarray, step: float) -> np.ndarray:
    """Lower each cell to what its neighbours allow at `step` m a cell; infinite cells are filled."""
    result = heights.copy()
    wide, deep = result.shape
    for turn in range(4):
        for a in range(wide):
            i = a if turn % 2 == 0 else wide - 1 - a
            for b in range(deep):
                j = b if turn < 2 else deep - 1 - b
                best = result[i, j]
                for di in range(-1, 2):
                    for dj in range(-1, 2):
                        if 0 <= i + di < wide and 0 <= j + dj < deep:
                            best = min(best, result[i + di, j + dj] + step * np.sqrt(float(di * di + dj * dj)))
                result[i, j] = best
    return result


@njit(cache=True, nogil=True)
def _height_over(points: np.ndarray, heights: np.ndarray, low: np.ndarray) -> np.ndarray:
    result = np.empty(len(points))
    wide, deep = heights.shape
    for row in range(len(points)):
        u = min(max((points[row, 0] - low[0]) / CELL_M - 0.5, 0.0), wide - 1.0)
        v = min(max((points[row, 1] - low[1]) / CELL_M - 0.5, 0.0), deep - 1.0)
        i, j = min(int(u), max(wide - 2, 0)), min(int(v), max(deep - 2, 0))
        k, m = min(i + 1, wide - 1), min(j + 1, deep - 1)
        u, v = u - i, v - j
        floor = (1 - u) * ((1 - v) * heights[i, j] + v * heights[i, m]) + u * (
            (1 - v) * heights[k, j] + v * heights[k, m]
        )
        result[row] = points[row, 2] - floor
    return result
