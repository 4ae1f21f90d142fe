# SPDX-License-Identifier: Apache-2.0
"""Places that the sensor once saw through: what stands there now has come, as people do and furniture does not."""

from __future__ import annotations

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F64, Bools

CELL_M, HALF_WIDTH_M = 0.2, 30.0  # edge of a cell; from the sensor to the edges of the grid
HEIGHT_LIMITS_M = (-5.4, 2.6)  # of the grid, from the sensor
STRIDE = 8  # every so many rays are followed in a scan, others in the next
MARGIN_M = 0.4  # before the end of a ray, of what is not known to be free
MAX_COME_SHARE = 0.2
"""Share of a scan's points at places seen free from which on it is the sensor that moved, and nothing is known."""
MOVING_SCANS = 50  # for which a sensor that moved is taken to go on
MAX_DRIFT_M = 10.0  # of the sensor from the middle of the grid, beyond which it starts anew


class SeenFree:
    """Cells of the space about one sensor through which some ray passed in a scan without any point near."""

    def __init__(self) -> None:
        """Start without any."""
        self._shape = np.array(
            [2 * HALF_WIDTH_M / CELL_M, 2 * HALF_WIDTH_M / CELL_M, np.ptp(HEIGHT_LIMITS_M) / CELL_M]
        ).astype(np.int64)
        self._free: np.ndarray | None = None
        self._near = self._hit = np.empty(0, np.uint8)
        self._low = np.zeros(3)
        self._scan = 0
        self._moving_scans = 0

    def reset(self) -> None:
        """Forget everything."""
        self._free = None
        self._moving_scans = 0

    @property
    def moves(self) -> bool:
        """Whether the sensor moved not long ago against the frame in which its scans are."""
        return self._moving_scans > 0

    def add(self, points: F64, viewpoint: F64) -> Bools:
        """Return which (N,) of a scan's points (N, 3) m are where the scans before saw through, and remember it.

        The points are in a frame that is the same for all scans, in which the sensor is at `viewpoint` (3,) m.
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        corner = viewpoint - np.array([HALF_WIDTH_M, HALF_WIDTH_M, -HEIGHT_LIMITS_M[0]])
        if self._free is None or np.abs(corner - self._low).max() > MAX_DRIFT_M:
            self._free = np.zeros(self._shape, np.bool_)
            self._near, self._hit = np.zeros(self._shape, np.uint8), np.zeros(self._shape, np.uint8)
            self._low = corner
            self._scan = 0
        come = _look_up(points, self._free, self._low)
        self._moving_scans = max(self._moving_scans - 1, 0)
        if come.sum() > MAX_COME_SHARE * len(come):
            self._free[:] = False
            self._moving_scans = MOVING_SCANS
        if self.moves:
            come[:] = False
        number = 1 + self._scan % 255
        if number == 1:
            self._near[:] = self._hit[:] = 0
        _mark_near(points, self._near, self._hit, number, self._low)
        _follow_rays(points[self._scan % STRIDE :: STRIDE], viewpoint, self._near, number, self._free, self._low)
        self._scan += 1
        return np.asarray(come)


@njit(cache=True, nogil=True)
def _look_up(points, free, low):  # type: ignore[no-untyped-def]
    found = np.zeros(len(points), np.bool_)
    for row in range(len(points)):
        i, j, k = _find_cell(points[row, 0], points[row, 1], points[row, 2], low)
        if 0 <= i < free.shape[0] and 0 <= j < free.shape[1] and 0 <= k < free.shape[2]:
            found[row] = free[i, j, k]
    return found


@njit(cache=True, nogil=True)
def _find_cell(x, y, z, low):  # type: ignore[no-untyped-def]
    return (
        int(np.floor((x - low[0]) / CELL_M)),
        int(np.floor((y - low[1]) / CELL_M)),
        int(np.floor((z - low[2]) / CELL_M)),
    )


@njit(cache=True, nogil=True)
def _mark_near(points, near, hit, number, low):  # type: ignore[no-untyped-def]
    """Mark the cells with points, and those beside them, with the number of the scan."""
    wide, deep, high = near.shape
    for row in range(len(points)):
        i, j, k = _find_cell(points[row, 0], points[row, 1], points[row, 2], low)
        if 0 <= i < wide and 0 <= j < deep and 0 <= k < high:
            if hit[i, j, k] == number:
                continue
            hit[i, j, k] = number
        for a in range(max(i - 1, 0), min(i + 2, wide)):
            for b in range(max(j - 1, 0), min(j + 2, deep)):
                for c in range(max(k - 1, 0), min(k + 2, high)):
                    near[a, b, c] = number


@njit(cache=True, nogil=True)
def _follow_rays(points, viewpoint, near, number, free, low):  # type: ignore[no-untyped-def]
    """Mark the cells that rays to points (N, 3) pass as free, but for those near a point of the scan."""
    wide, deep, high = near.shape
    for row in range(len(points)):
        x, y, z = points[row, 0] - viewpoint[0], points[row, 1] - viewpoint[1], points[row, 2] - viewpoint[2]
        reach = np.sqrt(x * x + y * y + z * z)
        for step in range(1, int((reach - MARGIN_M) / CELL_M)):
            share = step * CELL_M / reach
            i, j, k = _find_cell(viewpoint[0] + share * x, viewpoint[1] + share * y, viewpoint[2] + share * z, low)
            if not (0 <= i < wide and 0 <= j < deep and 0 <= k < high):
                break
            if near[i, j, k] != number:
                free[i, j, k] = True
