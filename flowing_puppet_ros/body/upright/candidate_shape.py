# SPDX-License-Identifier: Apache-2.0
"""What a candidate and its surroundings look like, in numbers that mean the same for every scanner and range."""

from __future__ import annotations

import numpy as np
from numba import njit

from flowing_puppet_ros.body.segmentation.candidates import Candidate, SceneHeights

SLICES_M = (0.15, 0.6, 1.0, 1.4, 2.0)  # heights over the floor between which a candidate is measured
RING_M, MAX_RADIUS_M = 0.5, 0.95  # of the surroundings
RING_HEIGHTS_M = (0.12, 0.7, 1.3, 2.2)
MAX_RING = 5.0  # points of the surroundings for each of the candidate's, beyond which more tell nothing
OVERHEAD_M = 0.6  # over the top, of what is over a candidate's head
MAX_SEEN_ABOVE_M, MIN_REACH_M = 0.5, 0.3
"""Height over the top that the sensor sees, beyond which more tells nothing, and distance from which rays are asked for
that: where it sees nothing above the top, the head may be cut off."""
SHAPE_NAMES = (
    "top", "lowest", "longer", "shorter", "flatness", "whole", "share_inside", "overhead", "head_width", "head_share",
    *(f"width_{k}" for k in range(len(SLICES_M) - 1)), *(f"depth_{k}" for k in range(len(SLICES_M) - 1)),
    *(f"share_{k}" for k in range(len(SLICES_M) - 1)), *(f"ring_{k}" for k in range(len(RING_HEIGHTS_M) - 1)),
    "seen_above",
)  # fmt: skip


def describe_candidates(candidates: list[Candidate], scene: SceneHeights, viewpoint: np.ndarray) -> np.ndarray:
    """Return the numbers (C, len(SHAPE_NAMES)) of candidates in a scene seen from `viewpoint` (3,) m."""
    shape = np.empty((len(candidates), len(SHAPE_NAMES)))
    slope = _find_steepest(scene.points, viewpoint) if candidates else 0.0
    for row, candidate in enumerate(candidates):
        near, away = scene.index.find_near(scene.points, candidate.middle, MAX_RADIUS_M)
        ahead = candidate.middle - viewpoint[:2]
        _describe(
            scene.points[candidate.rows],
            scene.height[candidate.rows],
            candidate.middle,
            ahead / max(float(np.linalg.norm(ahead)), 1e-9),
            scene.height[near],
            away,
            float(candidate.whole),
            shape[row],
        )
        ceiling = viewpoint[2] + slope * np.hypot(*ahead) - candidate.floor
        shape[row, -1] = np.clip(ceiling - candidate.top, 0.0, MAX_SEEN_ABOVE_M)
    return shape


@njit(cache=True, nogil=True)
def _describe(points, height, middle, ahead, around, away, whole, shape):  # type: ignore[no-untyped-def]
    """Fill `shape` in the order of `SHAPE_NAMES`, but for the last.

    `around` and `away` are heights and distances of what is near.
    """
    count, top, slices = len(points), height.max(), len(SLICES_M) - 1
    depth, across = np.empty(count), np.empty(count)
    for k in range(count):
        x, y = points[k, 0] - middle[0], points[k, 1] - middle[1]
        depth[k], across[k] = x * ahead[0] + y * ahead[1], y * ahead[0] - x * ahead[1]
    a, b, c = np.var(depth), np.var(across), np.mean(depth * across) - depth.mean() * across.mean()
    half, root = (a + b) / 2, np.sqrt(((a - b) / 2) ** 2 + c**2)
    shape[0], shape[1] = top, height.min()
    shape[2], shape[3] = np.sqrt(half + root), np.sqrt(max(half - root, 0.0))
    shape[4], shape[5] = shape[3] / max(shape[2], 1e-6), whole
    column, overhead = 0, 0
    ring = np.zeros(len(RING_HEIGHTS_M) - 1)
    for k in range(len(around)):
        if away[k] < RING_M:
            column += SLICES_M[0] < around[k] < SLICES_M[-1] + 0.1
            overhead += top + 0.05 < around[k] < top + OVERHEAD_M
        elif away[k] > RING_M:
            for level in range(len(ring)):
                ring[level] += RING_HEIGHTS_M[level] <= around[k] < RING_HEIGHTS_M[level + 1]
    head = height > top - 0.25
    shape[6], shape[7] = count / max(column, count), overhead / count
    shape[8], shape[9] = across[head].max() - across[head].min(), head.mean()
    for level in range(slices):
        own = (height >= SLICES_M[level]) & (height < SLICES_M[level + 1])
        several = own.sum() > 2
        shape[10 + level] = _measure_spread(across[own]) if several else -0.1
        shape[10 + slices + level] = _measure_spread(depth[own]) if several else -0.1
        shape[10 + 2 * slices + level] = own.mean()
    for level in range(len(ring)):
        shape[10 + 3 * slices + level] = min(ring[level] / count, MAX_RING)


@njit(cache=True, nogil=True)
def _find_steepest(points, viewpoint):  # type: ignore[no-untyped-def]
    """Return the slope of the highest ray of a scan with points (N, 3) m."""
    steepest = -np.inf
    for row in range(len(points)):
        x, y, z = points[row, 0] - viewpoint[0], points[row, 1] - viewpoint[1], points[row, 2] - viewpoint[2]
        reach = np.sqrt(x * x + y * y)
        if reach > MIN_REACH_M:
            steepest = max(steepest, z / reach)
    return steepest


@njit(cache=True, nogil=True)
def _measure_spread(values):  # type: ignore[no-untyped-def]
    """Return the distance from the 5th to the 95th percentile."""
    values = np.sort(values)
    ends = np.empty(2)
    for k in range(2):
        at = (0.05, 0.95)[k] * (len(values) - 1)
        low = int(at)
        high = min(low + 1, len(values) - 1)
        ends[k] = values[low] + (at - low) * (values[high] - values[low])
    return ends[1] - ends[0]
