# SPDX-License-Identifier: Apache-2.0
"""Whose points are whose: each point belongs to the person whose limbs, as capsules, it is nearest to in radii."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F64, I32

MAX_RADII, MAX_GROWN_RADII = 2.0, 3.2
"""Distance from the axis of a limb, in its radii, within which a point may be the person's, and within which it is
where the person's surface goes on up to it: joints are sometimes beside their limb."""
GROWTH_STEP_M, MAX_GROWTH_STEPS = 0.03, 6


def assign_points(points: F64, people: Sequence[F64]) -> I32:
    """Return the index of the person to whom each point belongs, (N,), -1 for those of nobody.

    Args:
        points: (N, 3) metres.
        people: (C, 8) of each person: two ends and two radii of each capsule, metres (`list_capsules`).
    """
    points = np.ascontiguousarray(points)
    best, owner = np.full(len(points), MAX_GROWN_RADII), np.full(len(points), -1, dtype=np.int32)
    for number, capsules in enumerate(people):
        if len(capsules):
            _claim(points, capsules, number, best, owner)
    claimed = np.flatnonzero(owner >= 0)
    claimed = claimed[np.argsort(points[claimed, 0], kind="stable")]
    sure = _grow(points[claimed], owner[claimed], best[claimed] < MAX_RADII)
    owner[claimed[~sure]] = -1
    return owner


@njit(cache=True, nogil=True)
def _grow(points, owner, sure):  # type: ignore[no-untyped-def]
    """Return which points (N,), in the order of x, are sure: those that are, and those where a person goes on up to.

    In every round a point becomes sure whose nearest sure point is within a step and of the same person.
    """
    sure, low = sure.copy(), 0
    maybe = np.flatnonzero(~sure)
    for _ in range(MAX_GROWTH_STEPS):
        grown, left = np.empty(len(maybe), np.int64), np.empty(len(maybe), np.int64)
        grown_count, left_count, low = 0, 0, 0
        for own in maybe:
            x, y, z = points[own, 0], points[own, 1], points[own, 2]
            while points[low, 0] < x - GROWTH_STEP_M:
                low += 1
            nearest, least, place = -1, GROWTH_STEP_M**2, low
            while place < len(points) and points[place, 0] <= x + GROWTH_STEP_M:
                if sure[place]:
                    dx, dy, dz = points[place, 0] - x, points[place, 1] - y, points[place, 2] - z
                    squared = dx * dx + dy * dy + dz * dz
                    if squared < least:
                        nearest, least = place, squared
                place += 1
            if nearest >= 0 and owner[nearest] == owner[own]:
                grown[grown_count] = own
                grown_count += 1
            else:
                left[left_count] = own
                left_count += 1
        if grown_count == 0:
            break
        sure[grown[:grown_count]] = True
        maybe = left[:left_count]
    return sure


@njit(cache=True, nogil=True)
def _claim(points, capsules, number, best, owner):  # type: ignore[no-untyped-def]
    """Give person `number` the points that are nearer to its capsules (C, 8) than `best` (N,) radii."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for c in range(len(capsules)):
        reach = best.max() * max(capsules[c, 6], capsules[c, 7]) if len(best) else 0.0
        for k in range(3):
            low[k] = min(low[k], min(capsules[c, k], capsules[c, 3 + k]) - reach)
            high[k] = max(high[k], max(capsules[c, k], capsules[c, 3 + k]) + reach)
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        if not (low[0] < x < high[0] and low[1] < y < high[1] and low[2] < z < high[2]):
            continue
        for c in range(len(capsules)):
            ax, ay, az = x - capsules[c, 0], y - capsules[c, 1], z - capsules[c, 2]
            bx = capsules[c, 3] - capsules[c, 0]
            by = capsules[c, 4] - capsules[c, 1]
            bz = capsules[c, 5] - capsules[c, 2]
            length = max(bx * bx + by * by + bz * bz, 1e-9)
            along = min(max((ax * bx + ay * by + az * bz) / length, 0.0), 1.0)
            dx, dy, dz = ax - along * bx, ay - along * by, az - along * bz
            radius = capsules[c, 6] + along * (capsules[c, 7] - capsules[c, 6])
            distance = np.sqrt(dx * dx + dy * dy + dz * dz) / radius
            if distance < best[n]:
                best[n], owner[n] = distance, number
