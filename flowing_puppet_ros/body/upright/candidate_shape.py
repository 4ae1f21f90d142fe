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
BELOW_TOP_M = (0.0, 0.12, 0.25, 0.45, 0.75, 1.1, 1.7)
"""Distances below the top between which a candidate is measured: the crown, the face, shoulders, and so on, however
tall somebody is."""
ROUND_M, MAX_ROUND_RADIUS_M, MIN_ROUND_POINTS = (0.0, 0.25, 0.75, 1.7), 1.0, 5
"""The same for how round it is, with the largest radius that is told, and the fewest points that tell it."""
EDGE_HEIGHT_M, EDGE_STEPS = 0.1, 15  # of the bands below the top whose left and right edges are compared
LEG_HEIGHTS_M, MIN_LEG_POINTS = (0.15, 0.7), 7
SHAPE_NAMES = (
    "top", "lowest", "longer", "shorter", "flatness", "whole", "share_inside", "overhead", "head_width", "head_share",
    *(f"width_{k}" for k in range(len(SLICES_M) - 1)), *(f"depth_{k}" for k in range(len(SLICES_M) - 1)),
    *(f"share_{k}" for k in range(len(SLICES_M) - 1)), *(f"ring_{k}" for k in range(len(RING_HEIGHTS_M) - 1)),
    *(f"{name}_below_{k}" for k in range(len(BELOW_TOP_M) - 1) for name in ("width", "depth", "share")),
    *(f"{name}_{k}" for k in range(len(ROUND_M) - 1) for name in ("unround", "radius")),
    "sway_across", "sway_ahead", "leg_gap", "leg_shift", "left_steps", "right_steps", "parallel",
)  # fmt: skip


def describe_candidates(candidates: list[Candidate], scene: SceneHeights, viewpoint: np.ndarray) -> np.ndarray:
    """Return the numbers (C, len(SHAPE_NAMES)) of candidates in a scene seen from `viewpoint` (3,) m."""
    shape = np.empty((len(candidates), len(SHAPE_NAMES)))
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
    return shape


@njit(cache=True, nogil=True)
def _describe(points, height, middle, ahead, around, away, whole, shape):  # type: ignore[no-untyped-def]
    """Fill `shape` in the order of `SHAPE_NAMES`; `around` and `away` are heights and distances of what is near."""
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
    first = 10 + 3 * slices + len(ring)
    _describe_below_top(depth, across, top - height, shape[first : first + 3 * len(BELOW_TOP_M) + 3 * len(ROUND_M) - 6])
    _describe_sides(depth, across, height, top, shape[len(shape) - 7 :])


@njit(cache=True, nogil=True)
def _describe_below_top(depth, across, below, shape):  # type: ignore[no-untyped-def]
    """Fill `shape` with widths, depths and shares of bands `below` the top, then with how round thicker ones are."""
    for band in range(len(BELOW_TOP_M) - 1):
        own = (below >= BELOW_TOP_M[band]) & (below < BELOW_TOP_M[band + 1])
        several = own.sum() > 2
        shape[3 * band] = _measure_spread(across[own]) if several else -0.1
        shape[3 * band + 1] = _measure_spread(depth[own]) if several else -0.1
        shape[3 * band + 2] = own.mean()
    first = 3 * (len(BELOW_TOP_M) - 1)
    for band in range(len(ROUND_M) - 1):
        own = (below >= ROUND_M[band]) & (below < ROUND_M[band + 1])
        misfit, radius = _fit_circle(depth[own], across[own])
        shape[first + 2 * band], shape[first + 2 * band + 1] = misfit, radius


@njit(cache=True, nogil=True)
def _fit_circle(x, y):  # type: ignore[no-untyped-def]
    """Return the mean distance of points from the circle that fits them, and its radius; -0.1 where few tell."""
    if len(x) < MIN_ROUND_POINTS:
        return -0.1, -0.1
    x, y = x - x.mean(), y - y.mean()
    a, b, c = (x * x).mean(), (y * y).mean(), (x * y).mean()
    square = x * x + y * y
    p, q = (x * square).mean() / 2, (y * square).mean() / 2
    determinant = max(a * b - c * c, 1e-12)
    u, v = (b * p - c * q) / determinant, (a * q - c * p) / determinant
    radius = np.sqrt(u * u + v * v + a + b)
    misfit = np.sqrt(((np.sqrt((x - u) ** 2 + (y - v) ** 2) - radius) ** 2).mean())
    return misfit, min(radius, MAX_ROUND_RADIUS_M)


@njit(cache=True, nogil=True)
def _describe_sides(depth, across, height, top, shape):  # type: ignore[no-untyped-def]
    """Fill `shape` (7,) with how the middle moves from band to band, the gap between legs, and how edges step."""
    bands = len(BELOW_TOP_M) - 1
    middles, count = np.empty((2, bands)), 0
    for band in range(bands):
        own = (top - height >= BELOW_TOP_M[band]) & (top - height < BELOW_TOP_M[band + 1])
        if own.sum() > 2:
            middles[0, count], middles[1, count] = np.median(across[own]), np.median(depth[own])
            count += 1
    for axis in range(2):
        shape[axis] = middles[axis, :count].std() if count > 1 else -0.1
    legs = np.sort(across[(height > LEG_HEIGHTS_M[0]) & (height < LEG_HEIGHTS_M[1])])
    shape[2] = np.diff(legs[1:-1]).max() if len(legs) >= MIN_LEG_POINTS else -0.1
    shape[3] = np.median(legs) - np.median(across) if len(legs) > 2 else 0.0
    edges, count = np.empty((2, EDGE_STEPS)), 0
    for step in range(EDGE_STEPS):
        low = top - (EDGE_STEPS - step) * EDGE_HEIGHT_M
        own = across[(height >= low) & (height < low + EDGE_HEIGHT_M)]
        if len(own) > 2:
            edges[0, count], edges[1, count] = own.min(), own.max()
            count += 1
    left, right = edges[0, :count], edges[1, :count]
    shape[4] = np.abs(np.diff(left)).mean() if count > 2 else -0.1
    shape[5] = np.abs(np.diff(right)).mean() if count > 2 else -0.1
    spread = left.std() * right.std() if count > 3 else 0.0
    shape[6] = ((left - left.mean()) * (right - right.mean())).mean() / spread if spread > 0 else 0.0


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
