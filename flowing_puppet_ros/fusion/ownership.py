# SPDX-License-Identifier: Apache-2.0
"""Whose points are whose: each point belongs to the person whose limbs, as capsules, it is nearest to in radii."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F64, I8, I32
from flowing_puppet_ros.fusion.puppet_joints import PuppetJoints
from flowing_puppet_ros.fusion.seen_cloud import SeenCloud

MAX_RADII, MAX_GROWN_RADII, MAX_MASKED_RADII = 2.0, 3.2, 8.0
"""Distance from the axis of a limb, in its radii, within which a point may be the person's, and within which it is
where the person's surface goes on up to it: joints are sometimes beside their limb. The last: within a mask."""
GROWTH_STEP_M, MASKED_STEP_M, MAX_GROWTH_STEPS = 0.03, 0.05, 6
"""From a point that is the person's to the next, and within a mask, where hardly a thing can be."""

OUTSIDE, UNSEEN, SHOWN = 0, 1, 2
"""What a mask says of a point: it is not the person's, the camera does not tell, or it is the person's by its pixel."""
PERSON_SIDE_M = 0.75
"""Side of a square as large as what one sees of a person: it tells how long a metre is in a mask."""
JOINT_MARGIN_M, MIDDLE_MARGIN_M, LIMB_RADIUS_M, HAND_RADIUS_M = 0.06, 0.03, 0.08, 0.15
"""Outside of a mask, up to which a joint may be beside its limb and the middle between two; around the bones of a limb
that a mask lacks, and around its joints, of which one may be a wrist or an ankle."""
MAX_OUTSIDE_SHARE = 0.3
"""Of the sure joints, outside of a mask that is still the person's."""
EDGE_PX = 1.5
"""Beside a mask, up to which points are inside."""


def find_shown(cloud: SeenCloud, puppet: PuppetJoints, bones: Sequence[tuple[int, int]]) -> I8 | None:
    """Return what a person's mask says of the points (N,): OUTSIDE, UNSEEN or SHOWN; None where it is not to believe.

    Networks see a neighbour in place of somebody, or leave a foot or a raised forearm out, and a mask that was carried
    along the flow misses a fast hand: a mask that lacks sure joints is not believed
    around their `bones` (pairs of joints), and not at all if it lacks many.
    """
    mask, sure = puppet.mask, np.flatnonzero(puppet.sure)
    if mask is None or not len(sure) or mask.area <= 0:
        return None
    metre = np.sqrt(mask.area) / PERSON_SIDE_M
    near = mask.find_near(cloud.pixels, mask.slack + EDGE_PX)
    whole = [(first, last) for first, last in bones if first in sure and last in sure]
    middles = np.array([puppet.pixels[list(ends)].mean(axis=0) for ends in whole]).reshape(-1, 2)
    places = np.concatenate([puppet.pixels[sure], middles, cloud.pixels[near]])
    distance, middle, beside = np.split(mask.measure_distance(places) - mask.slack, [len(sure), len(sure) + len(whole)])
    broken = {ends for ends, away in zip(whole, middle, strict=True) if away > MIDDLE_MARGIN_M * metre}
    lacking = sure[distance > JOINT_MARGIN_M * metre]
    if len(lacking) > MAX_OUTSIDE_SHARE * len(sure):
        return None
    shown = np.where(cloud.seen, np.int8(OUTSIDE), np.int8(UNSEEN))
    shown[near[beside <= EDGE_PX]] = SHOWN
    with np.errstate(invalid="ignore"):
        for joint in lacking:
            around = np.hypot(*(cloud.pixels - puppet.pixels[joint]).T) < HAND_RADIUS_M * metre
            shown[around & (shown == OUTSIDE)] = UNSEEN
        for first, last in bones:
            misses = first in lacking or last in lacking or (first, last) in broken
            if not (misses and puppet.known[first] and puppet.known[last]):
                continue
            start, along = puppet.pixels[first], puppet.pixels[last] - puppet.pixels[first]
            share = np.clip((cloud.pixels - start) @ along / max(float(along @ along), 1e-9), 0.0, 1.0)
            limb = np.hypot(*(cloud.pixels - start - share[:, None] * along).T) < LIMB_RADIUS_M * metre
            shown[limb & (shown == OUTSIDE)] = UNSEEN
    return shown


def assign_points(points: F64, people: Sequence[F64], shown: Sequence[I8 | None] = ()) -> I32:
    """Return the index of the person to whom each point belongs, (N,), -1 for those of nobody.

    Args:
        points: (N, 3) metres.
        people: (C, 8) of each person: two ends and two radii of each capsule, metres (`list_capsules`).
        shown: (N,) of the first people, what their masks say of the points (`find_shown`); None without one.
    """
    points = np.ascontiguousarray(points)
    best, owner = np.full(len(points), np.inf), np.full(len(points), -1, dtype=np.int32)
    unseen, step = np.full(len(points), UNSEEN, dtype=np.int8), np.full(len(people), GROWTH_STEP_M)
    for number, capsules in enumerate(people):
        own = shown[number] if number < len(shown) else None
        if own is not None:
            step[number] = MASKED_STEP_M
        if len(capsules):
            _claim(points, capsules, unseen if own is None else own, number, best, owner)
    claimed = np.flatnonzero(owner >= 0)
    claimed = claimed[np.argsort(points[claimed, 0], kind="stable")]
    sure = _grow(points[claimed], owner[claimed], best[claimed] < MAX_RADII, step[owner[claimed]])
    owner[claimed[~sure]] = -1
    return owner


@njit(cache=True, nogil=True)
def _grow(points, owner, sure, step):  # type: ignore[no-untyped-def]
    """Return which points (N,), in the order of x, are sure: those that are, and those where a person goes on up to.

    In every round a point becomes sure whose nearest sure point is within its `step` (N,) m and of the same person.
    """
    sure, low = sure.copy(), 0
    maybe = np.flatnonzero(~sure)
    for _ in range(MAX_GROWTH_STEPS):
        grown, left = np.empty(len(maybe), np.int64), np.empty(len(maybe), np.int64)
        grown_count, left_count, low = 0, 0, 0
        for own in maybe:
            x, y, z = points[own, 0], points[own, 1], points[own, 2]
            while points[low, 0] < x - MASKED_STEP_M:
                low += 1
            nearest, least, place = -1, step[own] ** 2, low
            while place < len(points) and points[place, 0] <= x + step[own]:
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
def _claim(points, capsules, shown, number, best, owner):  # type: ignore[no-untyped-def]
    """Give person `number` the points that are nearer to its capsules (C, 8) than `best` (N,) radii, if a mask lets it.

    `shown` (N,) is what the mask says of them.
    """
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for c in range(len(capsules)):
        reach = MAX_MASKED_RADII * max(capsules[c, 6], capsules[c, 7])
        for k in range(3):
            low[k] = min(low[k], min(capsules[c, k], capsules[c, 3 + k]) - reach)
            high[k] = max(high[k], max(capsules[c, k], capsules[c, 3 + k]) + reach)
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        if shown[n] == OUTSIDE or not (low[0] < x < high[0] and low[1] < y < high[1] and low[2] < z < high[2]):
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
            if distance < min(best[n], MAX_MASKED_RADII if shown[n] == SHOWN else MAX_GROWN_RADII):
                best[n], owner[n] = distance, number
