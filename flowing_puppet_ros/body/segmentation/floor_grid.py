# SPDX-License-Identifier: Apache-2.0
"""The floor of a scene as a grid of heights: a plane, and how far pavements, ramps and thresholds differ from it.

Near a LiDAR whose lowest ray looks little below the horizon no floor is seen. What that ray hits there only tells that
the floor is not above it. In a small room it may see none at all: then its level has to be known otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.ndimage import distance_transform_edt, gaussian_filter, minimum_filter1d

from flowing_puppet_ros.body.segmentation.column_index import lay_grid, sort_into_cells
from flowing_puppet_ros.body.segmentation.planes import find_floor, subsample

CELL_M, MAX_CELLS = 1.0, 200  # edge of a cell; cells a side, so that the grid ends there
LOW_SHARE = 0.03
"""Share of a cell's points that may lie below its floor: reflections and noise."""
MIN_CELL_POINTS = 3
MAX_SLOPE, MAX_RAMP_SLOPE = 0.05, 0.1
"""Of the floor against the plane, so that cells on furniture and cars take their neighbours' floor; of cells in which
nothing stands up."""
MAX_KERB_M = 0.2  # above the floor that is seen nearby: what is higher stands on it
MAX_BELOW_PLANE_M = 1.0  # a cell that is lower shows a reflection or a shaft
AZIMUTH_BINS, MIN_RAY_GAP, LIMIT_GAPS, MAX_RISE_M = 360, 0.005, 0.6, 0.1
"""Bins of azimuth in which the ray below another one is looked up, slope between two at least, gaps between the lowest
two from which on one is below another, and how much higher than this it may end where it ends on the floor."""
NEAR_BINS, MIN_CUT_AWAY = 10, 0.1
"""Bins to either side, and how much lower rays there look, where a floor was cut away; a scanner may be tilted."""
MIN_UPRIGHT_M = 0.35  # height of what stands in a cell; a floor is flat
PLANE_STEPS, PLANE_WIDTH_M = 12, 0.12  # of the robust fit; above the plane, cells count less beyond this width
MAX_PLANE_SLOPE = 0.25
BLUR_CELLS = 0.7
MIN_SEEN_CELLS, MIN_SEEN_SHARE = 2, 0.08  # cells, and their share, whose lowest points are on a floor that is seen
FLOOR_THICKNESS_M, MIN_FLOOR_SHARE, MAX_CEILING_SHARE = 0.1, 0.25, 0.08
"""Distance from the floor up to which points are on it, the share of a scan's points that are on it at least, and the
share that may be on what is lowest in a scan that is upside down, or below it in one that is not."""

UPSIDE_DOWN = "the floor seems to be above everything else: is the sensor upside down, or `up` set wrongly?"
TILTED = (
    "the floor seems to be tilted by {:.0f} degrees, so people are missed or lean: publish how the sensor is mounted on"
    " /tf_static, or set fixed_frame; level the points of a file"
)
ONE_RING = "the cloud is a flat scan, of one ring of rays: people are found from several rings on only"
TILT_CLEARANCE_M, MAX_TILT_RANGE_M = 0.1, 8.0  # half thickness of a floor, and how far from the sensor it is looked for
MIN_TOLD_TILT_RAD, MAX_TOLD_TILT_RAD = np.radians(8.0), np.radians(60.0)  # steeper planes are walls
MAX_RING_RAD, MIN_RING_POINTS = np.radians(0.7), 50  # extent of one ring across it


@dataclass(frozen=True, slots=True, eq=False)
class FloorGrid:
    """Heights of the floor: `heights` (W, D) m of cells from `low` (2,) m on, bilinear between their centres.

    `is_seen`: whether the points show any of it; else it is as high as the lowest thing that they show, or as given.
    """

    heights: np.ndarray
    low: np.ndarray
    is_seen: bool = True

    @classmethod
    def find(cls, points: np.ndarray, viewpoint: np.ndarray | None = None, level: float | None = None) -> FloorGrid:
        """Find the floor of a scene with points (N, 3) m, z up, N > 0; where none is seen, its neighbours' floor.

        Where the sensor at `viewpoint` (3,) m does not look down to the floor, what stands there says only that the
        floor is not above it. `level` is z in metres of the floor below the sensor, where it is known otherwise: it
        counts where the points show no floor, or only what lies above it.
        """
        points = np.ascontiguousarray(points)
        low, shape, all_inside = lay_grid(points, CELL_M, MAX_CELLS)
        lowest, upright, cut = _find_lowest(points, viewpoint, low, shape, all_inside)
        x, y = (low[k] + CELL_M * (np.arange(shape[k]) + 0.5) for k in (0, 1))
        plane = _fit_plane(lowest, cut, x, y, points)
        base = plane[0] + plane[1] * x[:, None] + plane[2] * y[None, :]
        heights = base + _lay_over(lowest - base, upright, cut)
        on_floor = int((~cut & (np.abs(lowest - heights) < FLOOR_THICKNESS_M)).sum())
        is_seen = on_floor >= max(MIN_SEEN_CELLS, MIN_SEEN_SHARE * np.isfinite(lowest).sum())
        found = cls(heights, low, is_seen)
        if viewpoint is None or level is None or (is_seen and found.locate(*viewpoint[:2]) < level + MAX_KERB_M):
            return found
        # All that stands there may be cut off by what is before it.
        above, beneath = lowest - level, np.clip((viewpoint[:2] - low) / CELL_M, 0, shape - 1).astype(np.int64)
        above[tuple(beneath)] = 0.0
        return cls(level + _lay_over(above, upright, upright), low, False)

    def height(self, points: np.ndarray) -> np.ndarray:
        """Return the heights (N,) of points (N, 3) over the floor, metres."""
        return _height_over(np.ascontiguousarray(points, dtype=np.float64), self.heights, self.low)

    def locate(self, x: float, y: float) -> float:
        """Return z of the floor at a place, metres."""
        return -float(self.height(np.array([[x, y, 0.0]]))[0])


def looks_upside_down(points: np.ndarray) -> bool:
    """Return whether a scene (N, 3) m with N > 0 has its floor above everything else: its sensor hangs head first."""
    height, other = (FloorGrid.find(each).height(each) for each in (points, points * np.array([1.0, 1.0, -1.0])))
    if (np.abs(other) < FLOOR_THICKNESS_M).mean() <= MIN_FLOOR_SHARE:
        return False
    too_low = (height < -MIN_UPRIGHT_M).mean()
    return bool((np.abs(height) < FLOOR_THICKNESS_M).mean() < MAX_CEILING_SHARE or too_low > MAX_CEILING_SHARE)


def describe_problem(points: np.ndarray, viewpoint: np.ndarray, nobody: bool) -> str:
    """Return why people are missed in a scan with points (N, 3) m, z up, seen from `viewpoint` (3,) m; or "".

    Where somebody is found the scan is neither flat nor upside down: of a room, the ceiling may be all that is level.
    """
    if not len(points):
        return ""
    if nobody and _is_one_ring(points - viewpoint):
        return ONE_RING
    if nobody and looks_upside_down(points):
        return UPSIDE_DOWN
    tilt = _measure_tilt(points, viewpoint)
    return TILTED.format(np.degrees(tilt)) if tilt > MIN_TOLD_TILT_RAD else ""


def _is_one_ring(rays: np.ndarray) -> bool:
    """Return whether rays (N, 3) m from the sensor make one cone or plane about z."""
    far = rays[np.linalg.norm(rays, axis=1) > TILT_CLEARANCE_M]  # nearer is the sensor itself
    elevation = np.arctan2(far[:, 2], np.hypot(far[:, 0], far[:, 1]))
    return len(far) >= MIN_RING_POINTS and bool(np.ptp(elevation) < MAX_RING_RAD)


def _measure_tilt(points: np.ndarray, viewpoint: np.ndarray) -> float:
    """Return how far the floor is from level, radians; 0 where it is not clear which plane is the floor."""
    thin = subsample(points[np.linalg.norm(points - viewpoint, axis=1) < MAX_TILT_RANGE_M])
    if len(thin) < MIN_RING_POINTS:
        return 0.0
    floor = find_floor(thin, TILT_CLEARANCE_M, np.random.default_rng(0), viewpoint, MAX_TOLD_TILT_RAD)
    if floor is None or (np.abs(floor.height(thin)) < TILT_CLEARANCE_M).mean() < MIN_FLOOR_SHARE:
        return 0.0
    return float(np.arccos(np.clip(floor.normal[2], -1.0, 1.0)))


def _find_open_below(points: np.ndarray, viewpoint: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return of which (K,) of the points `rows` (K,) among (N, 3) m no ray tells what is below them.

    The ray below ends on the floor where it ends no higher; else on what stands before it, or there is none. Where rays
    at other azimuths look far below, those that are missing were on a floor that was cut away.
    """
    slope, number, lowest, gaps = _find_slopes(points, viewpoint)
    gaps = gaps[np.isfinite(gaps)]
    margin = LIMIT_GAPS * float(np.median(gaps)) if len(gaps) else 0.0
    order = np.argsort(number, kind="stable")
    first = np.searchsorted(number[order], np.arange(AZIMUTH_BINS + 1))
    is_open, is_last = _compare_with_ray_below(points, slope, number, order, first, rows, margin)
    around = minimum_filter1d(lowest, 2 * NEAR_BINS + 1, mode="wrap")
    return np.asarray(is_open & ~(is_last & (slope[rows] > around[number[rows]] + MIN_CUT_AWAY)))


@njit(cache=True, nogil=True)
def _compare_with_ray_below(points, slope, number, order, first, rows, margin):  # type: ignore[no-untyped-def]
    """Return whether no ray just below a point ends as low, and whether there is none."""
    is_open, is_last = np.ones((2, len(rows)), np.bool_)
    for k in range(len(rows)):
        own = rows[k]
        begin, end = first[number[own]], first[number[own] + 1]
        below = -np.inf
        for place in range(begin, end):
            other = slope[order[place]]
            if other < slope[own] - margin:
                below = max(below, other)
        is_last[k] = below == -np.inf
        for place in range(begin, end):
            row = order[place]
            if below - margin < slope[row] <= below and points[row, 2] < points[own, 2] + MAX_RISE_M:
                is_open[k] = False
    return is_open, is_last


@njit(cache=True, nogil=True)
def _find_slopes(points, viewpoint):  # type: ignore[no-untyped-def]
    """Return the slopes (N,) of the rays, their bins (N,), the lowest slope in each, and the gap to the next one."""
    slope, number = np.empty(len(points)), np.empty(len(points), np.int64)
    lowest = np.full(AZIMUTH_BINS, np.inf)
    for row in range(len(points)):
        x, y = points[row, 0] - viewpoint[0], points[row, 1] - viewpoint[1]
        slope[row] = (points[row, 2] - viewpoint[2]) / max(np.sqrt(x * x + y * y), 1e-6)
        # Round a square instead of a circle, which tells bins as well in a fraction of the time.
        turn = y / max(abs(x) + abs(y), 1e-6)
        turn = turn if x >= 0 else 2.0 - turn
        number[row] = int((turn + 1.0) * (AZIMUTH_BINS / 4)) % AZIMUTH_BINS
        lowest[number[row]] = min(lowest[number[row]], slope[row])
    gaps = np.full(AZIMUTH_BINS, np.inf)
    for row in range(len(points)):
        gap = slope[row] - lowest[number[row]]
        if gap > MIN_RAY_GAP:
            gaps[number[row]] = min(gaps[number[row]], gap)
    return slope, number, lowest, gaps


def _find_lowest(
    points: np.ndarray, viewpoint: np.ndarray | None, low: np.ndarray, shape: np.ndarray, all_inside: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a low percentile (W, D) of z in each cell, and where something stands, and where its floor may be lower.

    The percentile is NaN where too few points are. The floor may be lower where the sensor at `viewpoint` (3,) m does
    not see below what stands there.
    """
    if not all_inside:
        points = points[~((points[:, :2] < low).any(axis=1) | (points[:, :2] >= low + CELL_M * shape).any(axis=1))]
    lowest, upright, least = _select_lowest(points, *sort_into_cells(points, low, shape, CELL_M))
    cut, standing = np.zeros(len(lowest), dtype=bool), np.flatnonzero(upright)
    if viewpoint is not None:
        cut[standing] = _find_open_below(points, viewpoint, least[standing])
    size = int(shape[0]), int(shape[1])
    return lowest.reshape(size), upright.reshape(size), cut.reshape(size)


@njit(cache=True, nogil=True)
def _select_lowest(points, order, first):  # type: ignore[no-untyped-def]
    """Return a low percentile of z in each cell, whether something stands in it, and its lowest point."""
    lowest = np.full(len(first) - 1, np.nan)
    upright, least = np.zeros(len(lowest), np.bool_), np.zeros(len(lowest), np.int64)
    for cell in range(len(lowest)):
        count = first[cell + 1] - first[cell]
        if count >= MIN_CELL_POINTS:
            z = np.empty(count)
            for k in range(count):
                z[k] = points[order[first[cell] + k], 2]
            least[cell] = order[first[cell] + z.argmin()]
            upright[cell] = z.max() - z.min() > MIN_UPRIGHT_M
            rank = int(LOW_SHARE * count)
            lowest[cell] = np.partition(z, rank)[rank]
    return lowest, upright, least


def _fit_plane(lowest: np.ndarray, cut: np.ndarray, x: np.ndarray, y: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the plane z = a + b x + c y (3,) below the cells' lowest points: furniture above counts little.

    Cells whose floor is lower (`cut`, W, D) count only where it would be above them.
    """
    rows, columns = np.nonzero(np.isfinite(lowest))
    if not len(rows):
        return np.array([np.percentile(points[:, 2], 100 * LOW_SHARE), 0.0, 0.0])
    z, open_below = lowest[rows, columns], cut[rows, columns]
    middle = np.array([x[rows].mean(), y[columns].mean()])
    table = np.stack([np.ones(len(z)), x[rows] - middle[0], y[columns] - middle[1]], axis=1)
    plane = np.array([np.percentile(z, 20) if open_below.all() else np.percentile(z[~open_below], 20), 0.0, 0.0])
    # Flat at first: a slope only once the level is known. The ridge keeps few cells from tilting it.
    for step in range(PLANE_STEPS):
        gap = z - table @ plane
        width = PLANE_WIDTH_M * (4 if step < PLANE_STEPS // 2 else 1)
        weight = 1 / (1 + np.where(gap > 0, gap / width, gap / MAX_BELOW_PLANE_M) ** 2) ** 2
        weight[open_below & (gap > 0)] = 0.0
        if not weight.any():  # it is below all that may stand on it
            break
        ridge = np.diag([1e-9, 20.0, 20.0])
        plane = np.linalg.solve((table * weight[:, None]).T @ table + ridge, (table * weight[:, None]).T @ z)
    slope = np.clip(plane[1:], -MAX_PLANE_SLOPE, MAX_PLANE_SLOPE)
    return np.array([plane[0] - slope @ middle, *slope])


def _lay_over(above: np.ndarray, upright: np.ndarray, cut: np.ndarray) -> np.ndarray:
    """Return how high the floor is (W, D) m over a plane over which the cells' lowest points are `above` (W, D) it.

    Something stands where `upright`; the floor may be lower where `cut`.
    """
    above = above.copy()
    above[np.isnan(above) | (above < -MAX_BELOW_PLANE_M) | (cut & (above > 0))] = np.inf
    if not np.isfinite(above).any():
        above[:] = 0.0
    eroded = _limit_slope(above, CELL_M * np.where(upright, MAX_SLOPE, MAX_RAMP_SLOPE))
    nearest = distance_transform_edt(eroded < above, return_distances=False, return_indices=True)
    floor = eroded[tuple(nearest)]
    # What is higher than a kerb stands on the floor, which is as high there as where it is seen.
    floor = np.where(above - floor > MAX_KERB_M, floor, eroded)
    return np.asarray(gaussian_filter(floor, BLUR_CELLS, mode="nearest"))


@njit(cache=True, nogil=True)
def _limit_slope(heights: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Lower each cell (W, D) to what its neighbours allow at its `step` (W, D) m a cell."""
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
                            best = min(best, result[i + di, j + dj] + step[i, j] * np.sqrt(float(di * di + dj * dj)))
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
