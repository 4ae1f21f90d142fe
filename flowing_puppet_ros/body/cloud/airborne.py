# SPDX-License-Identifier: Apache-2.0
"""Rain, snow and dust in a scan: points in the air, about which there are far fewer than a surface would show there.

How many points a surface shows depends on its distance and on how densely the scanner looks that way, so that no fixed
radius or count tells drops from people who are far away (Charron et al., De-noising of Lidar point clouds corrupted by
snowfall, 2018, whose radius grows with the distance).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F64, Bools

CELL_M, RANGE_M, HALF_HEIGHT_M = 0.15, 30.0, 6.0
"""Edge of a cell, and how far cells go from the sensor, across and up; what is beyond is kept."""
MAX_CLEAR_SHARE = 0.005
"""Share of the points that hang alone in clear air, too: fingers, cables, rays that graze an edge. These are kept."""
BIN_RAD, MAX_ELEVATION_RAD = np.radians(4.0), np.radians(88.0)
"""Edge of a bin of directions in which points are counted, and the elevations in which they are."""
MIN_SURFACE_SHARE = 0.04
"""Share of the points that a surface across the ray would show in the cells about a point, from which on it is one's:
an arm, a leg or a post fills a tenth of them."""


def find_airborne(points: F64, viewpoint: F64) -> Bools:
    """Return which (N,) of the points (N, 3) m, seen from `viewpoint` (3,) m, hang in the air alone; none if few do."""
    side, high = (2 * int(np.ceil(reach / CELL_M)) + 3 for reach in (RANGE_M, HALF_HEIGHT_M))
    alone = _find_airborne(np.ascontiguousarray(points), viewpoint, side, high)
    return np.asarray(alone & (alone.mean() > MAX_CLEAR_SHARE)) if len(points) else alone


@njit(cache=True, nogil=True)
def _find_airborne(points, viewpoint, side, high):  # type: ignore[no-untyped-def]
    count = len(points)
    cells = np.zeros((side, side, high), np.uint8)
    place, turn = np.empty((count, 3), np.int32), np.empty((count, 2), np.int32)
    wide, tall = int(np.ceil(2 * np.pi / BIN_RAD)), int(np.ceil(2 * MAX_ELEVATION_RAD / BIN_RAD))
    seen = np.zeros((wide, tall))
    squared = np.empty(count)
    size = np.array([side, side, high])
    for row in range(count):
        x, y, z = points[row, 0] - viewpoint[0], points[row, 1] - viewpoint[1], points[row, 2] - viewpoint[2]
        flat = np.sqrt(x * x + y * y)
        squared[row] = flat * flat + z * z
        elevation = min(max(np.arctan2(z, flat), -MAX_ELEVATION_RAD), MAX_ELEVATION_RAD)
        turn[row, 0] = min(int((np.arctan2(y, x) + np.pi) / BIN_RAD), wide - 1)
        turn[row, 1] = min(int((elevation + MAX_ELEVATION_RAD) / BIN_RAD), tall - 1)
        seen[turn[row, 0], turn[row, 1]] += 1 / np.cos(elevation)
        for axis, value in enumerate((x, y, z)):
            cell = int(np.floor(value / CELL_M)) + size[axis] // 2
            place[row, axis] = min(max(cell, 1), size[axis] - 2)
        i, j, k = place[row]
        cells[i, j, k] = min(cells[i, j, k] + 1, 255)
    alone = np.zeros(count, np.bool_)
    for row in range(count):
        density = seen[turn[row, 0], turn[row, 1]] / (BIN_RAD * BIN_RAD)
        needed = MIN_SURFACE_SHARE * density * (3 * CELL_M) ** 2 / max(squared[row], CELL_M * CELL_M)
        i, j, k = place[row]
        if cells[i, j, k] >= needed:
            continue
        near = 0.0
        for a in range(i - 1, i + 2):
            for b in range(j - 1, j + 2):
                for c in range(k - 1, k + 2):
                    near += cells[a, b, c]
        alone[row] = near < needed
    return alone
