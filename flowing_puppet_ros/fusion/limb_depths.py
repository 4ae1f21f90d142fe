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

from flowing_puppet_ros.arrays import F64, Bools
from flowing_puppet_ros.model.sp import StitchedPuppet

CORNERS = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")
CHAINS = (("shoulder", "elbow", "wrist", "hand"), ("hip", "knee", "ankle", "foot"))
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


def list_choices(
    ray: F64, axis: F64, centre: F64, surfaces: F64, offset: float, middle: float, reach: float, seen_share: float
) -> DepthChoices:
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
    """
    slope = float(ray @ axis)
    steps = int(reach / GRID_M)
    grid = middle + GRID_M * np.arange(-steps, steps + 1)
    on_surface = surfaces + offset * slope
    depth = np.concatenate([on_surface, grid])
    rank = np.arange(len(surfaces))
    behind = grid > on_surface.min() + GRID_M / 2 if len(surfaces) else np.ones(len(grid), dtype=bool)
    seen_cost = -np.log(seen_share) + np.log(2.0) * rank
    grid_cost = np.where(behind, -np.log(1 - seen_share), -np.log(MISSED))
    return DepthChoices(
        centre + ray * (depth / slope)[:, None],
        depth,
        np.concatenate([seen_cost, grid_cost]),
        np.arange(len(depth)) < len(surfaces),
    )


def measure_seen_share(confidence: float, hidden: bool) -> float:
    """Return the probability that a joint of a confidence (0 to 1) is seen; `hidden` by the puppet's own parts."""
    share = 1 / (1 + np.exp(-(confidence - HALF_SEEN_CONFIDENCE) / CONFIDENCE_WIDTH))
    return float(np.clip(share * (OWN_HIDDEN_FACTOR if hidden else 1.0), *SEEN_RANGE))


def choose_depths(model: StitchedPuppet, choices: Mapping[int, DepthChoices]) -> dict[int, int]:
    """Return which of its `choices` each joint takes, by the joint's number."""
    named = {model.joint_names[joint]: joint for joint in choices}
    template = model.joints(model.vertices(model.rest_state()))
    place = dict(zip(model.joint_names, template, strict=True))
    best: tuple[float, dict[str, int]] = (np.inf, {})
    for scale in SCALES:
        cost, taken = _choose_for_size({name: choices[row] for name, row in named.items()}, place, scale)
        cost += 0.5 * ((scale - 1) / SCALE_DEVIATION) ** 2
        if cost < best[0]:
            best = (cost, taken)
    return {named[name]: choice for name, choice in best[1].items()}


def _choose_for_size(
    choices: Mapping[str, DepthChoices], place: Mapping[str, F64], scale: float
) -> tuple[float, dict[str, int]]:
    """Return the least cost of a person of one size, and what each joint takes; `place` (3,) m of the mean body."""
    limbs = {}
    for side in ("left", "right"):
        for chain in CHAINS:
            names = [f"{side}_{name}" for name in chain if f"{side}_{name}" in choices]
            if names:
                limbs[names[0]] = (names, *_fold(names, choices, place, scale))
    own = {first: cost for first, (_, cost, _) in limbs.items()}
    total, picked = _choose_corners([name for name in CORNERS if name in own], choices, own, place, scale)
    taken = {}
    for first, (names, cost, back) in limbs.items():
        choice = picked.get(first, int(cost.argmin()))
        total += 0.0 if first in picked else float(cost[choice])
        taken[first] = choice
        for name, step in zip(names[1:], back, strict=True):
            taken[name] = int(step[taken[names[names.index(name) - 1]]])
    return total, taken


def _fold(
    names: Sequence[str], choices: Mapping[str, DepthChoices], place: Mapping[str, F64], scale: float
) -> tuple[F64, list[np.ndarray]]:
    """Return the least cost (C,) of a limb for each choice of its first joint, and the way along it."""
    cost = choices[names[-1]].cost
    back: list[np.ndarray] = []
    for near, far in zip(names[-2::-1], names[:0:-1], strict=True):
        length = scale * float(np.linalg.norm(place[near] - place[far]))
        table = measure_limb_cost(choices[near], choices[far], length) + cost
        back.insert(0, table.argmin(axis=1))
        cost = choices[near].cost + table.min(axis=1)
    return cost, back


def measure_bone_cost(a: F64, b: F64, length: float, spread: F64) -> F64:
    """Return what the distances between joints at `a` (A, 3) and `b` (B, 3) m cost for a bone of `length` m, (A, B).

    `spread` (A, B) m is the standard deviation of their places on their rays' pixels.
    """
    apart = np.linalg.norm(a[:, None] - b, axis=2)
    variance = (BONE_DEVIATION_M + BONE_DEVIATION_SHARE * length) ** 2 + spread**2
    return np.asarray(np.minimum(0.5 * (apart - length) ** 2 / variance, MAX_BONE_COST))


def measure_limb_cost(near: DepthChoices, far: DepthChoices, length: float) -> F64:
    """Return what the choices (A, B) of two joints next to each other along a limb cost, for a bone of `length` m."""
    slope = (near.depth[:, None] - far.depth) / SLOPE_M
    return np.asarray(_measure_pair_cost(near, far, length) + 0.5 * slope**2)


def _measure_pair_cost(a: DepthChoices, b: DepthChoices, length: float) -> F64:
    return measure_bone_cost(a.points, b.points, length, np.hypot(a.spread[:, None], b.spread))


def _choose_corners(
    corners: Sequence[str],
    choices: Mapping[str, DepthChoices],
    own: Mapping[str, F64],
    place: Mapping[str, F64],
    scale: float,
) -> tuple[float, dict[str, int]]:
    """Return the least cost and what each of the trunk's `corners` takes; `own` are their costs (C,) with limbs."""
    if not corners:
        return 0.0, {}
    total = np.zeros([1] * len(corners))
    for i, name in enumerate(corners):
        total = total + own[name].reshape([-1 if k == i else 1 for k in range(len(corners))])
        for j in range(i):
            length = scale * float(np.linalg.norm(place[name] - place[corners[j]]))
            table = _measure_pair_cost(choices[corners[j]], choices[name], length)
            shape = [len(own[corner]) if k in (i, j) else 1 for k, corner in enumerate(corners)]
            total = total + table.reshape(shape)
    index = np.unravel_index(int(total.argmin()), total.shape)
    return float(total[index]), {name: int(choice) for name, choice in zip(corners, index, strict=True)}
