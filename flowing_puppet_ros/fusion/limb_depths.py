# SPDX-License-Identifier: Apache-2.0
"""Which depth each joint has: that of a surface at its pixel, or another, so that all bones have their lengths.

At the pixel of a hidden joint the cloud shows what hides it, and at an inexact pixel the wall behind or another limb.
Each joint chooses among the surfaces at its pixel and a grid of other depths. A choice costs as much as the puppet's
confidence makes it improbable, and two joints cost the gap between their distance and the length of the bone. The
trunk's four joints are tried in all combinations, limbs by dynamic programming along them, both for people of several
sizes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numba.extending import register_jitable

from flowing_puppet_ros.arrays import F64, Bools
from flowing_puppet_ros.fusion.puppet_joints import find_average_joints
from flowing_puppet_ros.model.sp import StitchedPuppet

CHAINS = (("shoulder", "elbow", "wrist", "hand"), ("hip", "knee", "ankle", "foot"))
"""Of each limb, from the trunk's corner outwards."""
LIMB_JOINTS = tuple(f"{side}_{name}" for chain in CHAINS for side in ("left", "right") for name in chain)
CHAIN_JOINTS = 4
SCALES, SCALE_DEVIATION = (0.9, 1.0, 1.1), 0.08
"""Sizes of people relative to the model's mean that are tried, and their standard deviation."""
BONE_DEVIATION_M, BONE_DEVIATION_SHARE = 0.03, 0.1
"""Standard deviation of a bone's length: that of the joints, and a share of the length."""
HIDDEN_SPREAD_M = 0.05
"""Standard deviation of a hidden joint's place across its ray."""
MAX_BONE_COST = 8.0
GRID_M, TRUNK_REACH_M, LIMB_REACH_M = 0.08, 0.4, 0.8
"""Step of the grid of depths, and its ends from the trunk's depth for trunk and limbs."""
SLOPE_M = 0.35
"""Standard deviation of the depth from a joint to the next: limbs are seldom along the ray."""
HALF_SEEN_CONFIDENCE, CONFIDENCE_WIDTH = 0.5, 0.1
"""Confidence of a joint that is as often seen as hidden, and the width of the logistic curve."""
SEEN_RANGE = (0.05, 0.95)
"""Of the probability that a joint is seen."""
OWN_HIDDEN_FACTOR = 0.3
"""Of the probability that a joint is seen which the puppet's own parts hide."""
EXPECTED_DEVIATION_M, MAX_EXPECTED_COST = 0.1, 4.0
"""Standard deviation of a joint's depth where the clouds before let it be expected, and what it costs at most to be
elsewhere."""
MISSED = 0.1
"""Probability that the pixel misses the person so far that the joint is nearer than what the pixel shows."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthChoices:
    """What one joint chooses from.

    Attributes:
        points: (C, 3) metres.
        depth: (C,) metres along the camera's axis.
        cost: (C,), minus the logarithm of the probability.
        seen: (C,) whether the joint lies on a surface at its pixel.
    """

    points: F64
    depth: F64
    cost: F64
    seen: Bools

    @property
    def spread(self) -> F64:
        """Standard deviation (C,) of the places across the ray beyond that of seen joints, metres."""
        return np.where(self.seen, 0.0, HIDDEN_SPREAD_M)

    def take(self, rows: Sequence[int]) -> DepthChoices:
        """Return some of the choices."""
        chosen = list(rows)
        return DepthChoices(self.points[chosen], self.depth[chosen], self.cost[chosen], self.seen[chosen])


def list_choices(
    ray: F64, axis: F64, centre: F64, surfaces: F64, offset: float, middle: float, reach: float, seen_share: float,
    expected: float = float("nan"),
) -> DepthChoices:  # fmt: skip
    """List the depths of a joint.

    Args:
        ray: (3,) unit vector from the camera to the joint.
        axis: (3,) the camera's axis.
        centre: (3,) metres, the camera's.
        surfaces: (K,) depths of the surfaces at the pixel, metres, the most probable first; none where the sensor has
            no value.
        offset: distance of the joint behind the surface, metres along the ray.
        middle: depth of the trunk, metres.
        reach: of the grid around it, metres.
        seen_share: probability that the joint is seen.
        expected: depth of the joint, metres, where the clouds before let it be expected, else NaN: a pixel beside a
            thin limb shows what is behind it.
    """
    return DepthChoices(*_list_choices(ray, axis, centre, surfaces, offset, middle, reach, seen_share, expected))


@njit(cache=True, nogil=True)
def _list_choices(ray, axis, centre, surfaces, offset, middle, reach, seen_share, expected):  # type: ignore[no-untyped-def]
    slope = ray[0] * axis[0] + ray[1] * axis[1] + ray[2] * axis[2]
    steps, count = int(reach / GRID_M), len(surfaces)
    depth, cost = np.empty(count + 2 * steps + 1), np.empty(count + 2 * steps + 1)
    nearest = np.inf
    for k in range(count):
        depth[k] = surfaces[k] + offset * slope
        cost[k] = np.log(2.0) * k - np.log(seen_share)
        nearest = min(nearest, depth[k])
    for step in range(2 * steps + 1):
        depth[count + step] = middle + GRID_M * (step - steps)
        in_front = count > 0 and depth[count + step] <= nearest + GRID_M / 2
        cost[count + step] = -np.log(MISSED if in_front else 1 - seen_share)
    points = np.empty((len(depth), 3))
    for k in range(len(depth)):
        for i in range(3):
            points[k, i] = centre[i] + ray[i] * (depth[k] / slope)
        if np.isfinite(expected):
            cost[k] += min(0.5 * ((depth[k] - expected) / EXPECTED_DEVIATION_M) ** 2, MAX_EXPECTED_COST)
    return points, depth, cost, np.arange(len(depth)) < count


def measure_seen_share(confidence: F64, hidden: Bools | None = None) -> F64:
    """Return the probabilities (J,) that joints are seen, by their confidence (J,) 0 to 1.

    `hidden` (J,) are those that the puppet's own parts hide, if that counts.
    """
    share = 1 / (1 + np.exp(-(confidence - HALF_SEEN_CONFIDENCE) / CONFIDENCE_WIDTH))
    if hidden is not None:
        share = np.where(hidden, OWN_HIDDEN_FACTOR * share, share)
    return np.asarray(np.clip(share, *SEEN_RANGE))


def choose_depths(model: StitchedPuppet, choices: Mapping[int, DepthChoices]) -> dict[int, int]:
    """Return which of its `choices` each joint takes, by the joint's number."""
    rows = [model.joint_names.index(name) for name in LIMB_JOINTS]
    count = np.array([len(choices[row].depth) if row in choices else 0 for row in rows])
    if not count.any():
        return {}
    place, lists = np.zeros((len(rows), count.max(), 3)), np.zeros((3, len(rows), count.max()))
    for slot, row in enumerate(rows):
        if row in choices:
            own = choices[row]
            place[slot, : count[slot]] = own.points
            lists[:, slot, : count[slot]] = own.depth, own.cost, own.spread
    template = find_average_joints(model)[rows]
    best, cost = np.full(len(rows), -1), np.inf
    for scale in SCALES:
        total, taken = _choose_for_size(count, place, lists, scale * template)
        total += 0.5 * ((scale - 1) / SCALE_DEVIATION) ** 2
        if total < cost:
            best, cost = taken, total
    return {row: int(choice) for row, choice in zip(rows, best, strict=True) if choice >= 0}


@njit(cache=True, nogil=True)
def _choose_for_size(count, place, lists, template):  # type: ignore[no-untyped-def]
    """Return the least cost of a person of one size, and what each joint (16,) takes, -1 for those without choices.

    `count` (16,) are the numbers of choices, `place` (16, C, 3) m theirs, `lists` (3, 16, C) their depths, costs and
    spreads, and `template` (16, 3) m the joints of the mean body.
    """
    cost, back = lists[1].copy(), np.zeros((len(count), place.shape[1]), np.int64)
    first, after = np.full(len(count) // CHAIN_JOINTS, -1), np.full(len(count), -1)
    for limb in range(len(first)):
        for near in range(CHAIN_JOINTS * (limb + 1) - 1, CHAIN_JOINTS * limb - 1, -1):
            if count[near] == 0:
                continue
            far = first[limb]
            first[limb], after[near] = near, far
            if far >= 0:
                _fold(near, far, count, (place, lists, template), cost, back)
    total, taken = _choose_corners(first, count, (place, lists, template), cost)
    for limb in range(len(first)):
        near = first[limb]
        if near >= 0 and taken[near] < 0:
            taken[near] = cost[near, : count[near]].argmin()
            total += cost[near, taken[near]]
        while near >= 0 and after[near] >= 0:
            taken[after[near]] = back[near, taken[near]]
            near = after[near]
    return total, taken


@njit(cache=True, nogil=True)
def _fold(near, far, count, joints, cost, back):  # type: ignore[no-untyped-def]
    """Add the cost (16, C) of the limb from `far` on to each choice of `near`, and note the choice of `far`."""
    place, lists, template = joints
    length = _measure_gap(template[near], template[far])
    for i in range(count[near]):
        least = np.inf
        for j in range(count[far]):
            spread = np.hypot(lists[2, near, i], lists[2, far, j])
            own = cost[far, j] + _cost_bone(_measure_gap(place[near, i], place[far, j]), length, spread)
            own += 0.5 * ((lists[0, near, i] - lists[0, far, j]) / SLOPE_M) ** 2
            if own < least:
                least, back[near, i] = own, j
        cost[near, i] += least


@njit(cache=True, nogil=True)
def _choose_corners(first, count, joints, cost):  # type: ignore[no-untyped-def]
    """Return the least cost of the trunk's corners with their limbs, and what they take (16,), -1 elsewhere.

    `first` (4,) are the first joints of the limbs, of which those that are corners count, and `cost` (16, C).
    """
    place, lists, template = joints
    most, limbs = place.shape[1], len(first)
    sizes, own = np.ones(limbs, np.int64), np.zeros((limbs, most))
    pair = np.zeros((limbs, limbs, most, most))
    is_corner = first == CHAIN_JOINTS * np.arange(limbs)
    for a in range(limbs):
        if not is_corner[a]:
            continue
        sizes[a], own[a] = count[first[a]], cost[first[a]]
        for b in range(a):
            if not is_corner[b]:
                continue
            length = _measure_gap(template[first[a]], template[first[b]])
            for i in range(count[first[a]]):
                for j in range(count[first[b]]):
                    spread = np.hypot(lists[2, first[a], i], lists[2, first[b], j])
                    apart = _measure_gap(place[first[a], i], place[first[b], j])
                    pair[a, b, i, j] = _cost_bone(apart, length, spread)
    least, found = np.inf, np.zeros(limbs, np.int64)
    for i in range(sizes[0]):
        for j in range(sizes[1]):
            two = own[0, i] + own[1, j] + pair[1, 0, j, i]
            for k in range(sizes[2]):
                three = two + own[2, k] + pair[2, 0, k, i] + pair[2, 1, k, j]
                for m in range(sizes[3]):
                    total = three + own[3, m] + pair[3, 0, m, i] + pair[3, 1, m, j] + pair[3, 2, m, k]
                    if total < least:
                        least = total
                        found[0], found[1], found[2], found[3] = i, j, k, m
    taken = np.full(len(count), -1)
    for a in range(limbs):
        if is_corner[a]:
            taken[first[a]] = found[a]
    return least, taken


@register_jitable
def _measure_gap(a, b):  # type: ignore[no-untyped-def]
    return np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@register_jitable
def _cost_bone(apart, length, spread):  # type: ignore[no-untyped-def]
    variance = (BONE_DEVIATION_M + BONE_DEVIATION_SHARE * length) ** 2 + spread**2
    return np.minimum(0.5 * (apart - length) ** 2 / variance, MAX_BONE_COST)


def measure_bone_cost(a: F64, b: F64, length: float, spread: F64) -> F64:
    """Return what the distances between joints at `a` (A, 3) and `b` (B, 3) m cost for a bone of `length` m, (A, B).

    `spread` (A, B) m is the standard deviation of their places on their rays' pixels.
    """
    return np.asarray(_cost_bone(np.linalg.norm(a[:, None] - b, axis=2), length, spread))


def measure_limb_cost(near: DepthChoices, far: DepthChoices, length: float) -> F64:
    """Return what the choices (A, B) of two joints next to each other along a limb cost, for a bone of `length` m."""
    slope = (near.depth[:, None] - far.depth) / SLOPE_M
    spread = np.hypot(near.spread[:, None], far.spread)
    return measure_bone_cost(near.points, far.points, length, spread) + 0.5 * slope**2
