# SPDX-License-Identifier: Apache-2.0
"""Single linkage of points, also of those whose spacing grows with the distance from the sensor (rings of a LiDAR)."""

from __future__ import annotations

import numpy as np
from numba import njit

GAP_M, GAP_PER_M, GAP_LIMITS_M = 0.10, 0.012, (0.15, 0.40)
"""Gap between points of one thing: at the sensor, more of it for each metre of distance, and its limits."""
CELL_M, MAX_GAP_STEP_M = 0.2, 0.005
"""Width of the columns of the linkage, and by how much the gaps of two points that are joined differ at most."""
HEIGHT_SCALE = 0.4  # of vertical distances, which joins the rings
VOXEL_M = (0.07, 0.10)  # edge across and up; points of one voxel are taken for one


def thin_points(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the means (M, 3) of the points (N, 3) m in each voxel, and the voxel (N,) of each point."""
    if not len(points):
        return np.empty((0, 3)), np.empty(0, dtype=np.int64)
    low = points.min(axis=0)
    cell = ((points - low) / np.array([VOXEL_M[0], VOXEL_M[0], VOXEL_M[1]])).astype(np.int64)
    wide = cell.max(axis=0) + 1
    key = (cell[:, 0] * wide[1] + cell[:, 1]) * wide[2] + cell[:, 2]
    voxel = np.unique(key, return_inverse=True)[1]
    count = np.bincount(voxel)
    return np.stack([np.bincount(voxel, column) / count for column in points.T], axis=1), voxel


def link_points(points: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Return the cluster (N,) of each point; points nearer than the gap at their distance belong together.

    Args:
        points: (N, 3) m, thinned.
        distance: (N,) m from the sensor.
    """
    if not len(points):
        return np.empty(0, dtype=np.int64)
    gap = np.clip(GAP_M + GAP_PER_M * distance, *GAP_LIMITS_M)
    scaled = points * np.array([1.0, 1.0, HEIGHT_SCALE])
    return np.unique(_link_in_cells(scaled, gap, CELL_M), return_inverse=True)[1]


def link_within(points: np.ndarray, gap: float) -> np.ndarray:
    """Return the cluster (N,) of each point (N, 3), by its first point; points closer than `gap` belong together."""
    if not len(points):
        return np.empty(0, dtype=np.int64)
    label = _link_in_cells(points, np.full(len(points), gap), gap)
    _, first, cluster = np.unique(label, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[cluster]


def _link_in_cells(points: np.ndarray, gap: np.ndarray, width: float) -> np.ndarray:
    """Return a number (N,) that the points (N, 3) of a cluster share; they lie in columns of a `width`.

    The `gap` (N,) may differ by `MAX_GAP_STEP_M` between points that it joins.
    """
    low = points[:, :2].min(axis=0)
    cell = ((points[:, :2] - low) / width).astype(np.int64)
    deep = int(cell[:, 1].max()) + 1 + 2 * int(np.ceil((gap.max() + MAX_GAP_STEP_M) / width))
    key = cell[:, 0] * deep + cell[:, 1]
    order = np.argsort(key, kind="stable")
    label = np.empty(len(points), dtype=np.int64)
    label[order] = _link(np.ascontiguousarray(points[order], dtype=np.float64), gap[order], key[order], deep, width)
    return label


@njit(cache=True, nogil=True)
def _find_root(parent: np.ndarray, row: int) -> int:
    while parent[row] != row:
        parent[row] = parent[parent[row]]
        row = parent[row]
    return row


@njit(cache=True, nogil=True)
def _link(points: np.ndarray, gap: np.ndarray, key: np.ndarray, deep: int, width: float) -> np.ndarray:
    """Join points, sorted by the `key` of their cell, with those of their own cell and of the neighbours ahead."""
    count = len(points)
    parent = np.arange(count)
    start = 0
    while start < count:
        end, largest = start, 0.0
        while end < count and key[end] == key[start]:
            largest = max(largest, gap[end])
            end += 1
        reach = int(np.ceil((largest + MAX_GAP_STEP_M) / width))
        _join(points, gap, parent, start, end, start, end)
        for ahead in range(reach + 1):
            first = 1 if ahead == 0 else -reach
            # The cells of one column lie one after the other.
            low = np.searchsorted(key, key[start] + ahead * deep + first)
            high = np.searchsorted(key, key[start] + ahead * deep + reach + 1)
            _join(points, gap, parent, start, end, low, high)
        start = end
    for row in range(count):
        parent[row] = _find_root(parent, row)
    return parent


@njit(cache=True, nogil=True)
def _join(points, gap, parent, start, end, low, high):  # type: ignore[no-untyped-def]
    """Join those of the points from `start` to `end` with those from `low` to `high` that are nearer than the gap."""
    for row in range(start, end):
        x, y, z, own = points[row, 0], points[row, 1], points[row, 2], gap[row]
        for other in range(max(low, row + 1), high):
            limit = max(own, gap[other])
            dx, dy, dz = x - points[other, 0], y - points[other, 1], z - points[other, 2]
            if dx * dx + dy * dy + dz * dz < limit * limit:
                a, b = _find_root(parent, row), _find_root(parent, other)
                if a != b:
                    parent[max(a, b)] = min(a, b)
