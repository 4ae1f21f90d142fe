# SPDX-License-Identifier: Apache-2.0
"""From the last particles to results: the best pose, others that differ in the arms, and each joint's confidence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.image.pose.particle_search import PoseSearch, ScoredPartParticles, SearchTarget
from flowing_puppet_ros.inference.max_product import MaxProduct, max_product
from flowing_puppet_ros.model.ds.joints import PART_JOINTS
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

WRIST_SD_M = 0.15
"""Standard deviation of the kernel in which hypotheses of a wrist count as the same."""

AGREEMENT_RADIUS_M = 0.1
"""Distance within which other particles agree with a joint."""

MODE_TEMPERATURE = 15.0
"""Cost difference in nats at which a hypothesis weighs 1/e of the best one when diverse ones are chosen."""

CONFIDENCE_TEMPERATURE = 15.0
"""Cost difference in nats at which a particle weighs 1/e of the best one in a joint's confidence."""

_FORBIDDEN_COST = 1e9  # of particles other than the pinned one


@dataclass(frozen=True, slots=True, eq=False)
class PoseMode:
    """One pose: `joints` (J, 2) px, NaN where nothing was searched, its energy in nats, and scale px/m."""

    joints: Array
    energy: float
    scale: float


def extract_modes(
    model: DeformableStructures, search: PoseSearch, scored: list[ScoredPartParticles], target: SearchTarget, count: int
) -> list[PoseMode]:
    """Return up to `count` poses that differ in their arms: the best of all first, then by increasing energy.

    The k-th hypothesis of the right wrist goes with the k-th of the left one; the rest is the best for both.
    """
    result, edges = search.solve(scored)
    arms = [k for k, name in enumerate(search.tree.names) if name.endswith("lower_arm")]
    choices = {k: _select_diverse_wrists(search, k, scored[k], result, target, count) for k in arms}
    solutions = [_make_mode(model, search, scored, result.assignment, result.cost, target)]
    for rank in range(1, max((len(chosen) for chosen in choices.values()), default=0)):
        costs = [group.cost.copy() for group in scored]
        for k, chosen in choices.items():
            pinned = chosen[min(rank, len(chosen) - 1)]
            costs[k] += _FORBIDDEN_COST
            costs[k][pinned] -= _FORBIDDEN_COST
        other = max_product(search.tree, costs, edges)
        solutions.append(_make_mode(model, search, scored, other.assignment, other.cost, target))
    return [solutions[0], *sorted(solutions[1:], key=lambda one: one.energy)]


def joint_confidence(
    model: DeformableStructures,
    search: PoseSearch,
    scored: list[ScoredPartParticles],
    result: MaxProduct,
    target: SearchTarget,
    joints: Array,
) -> Array:
    """Return the share (J,) of the particles' weight, by max-marginal, whose joint is near that of `joints` (J, 2).

    0 for joints that were not searched.
    """
    confidence = np.zeros(len(model.joint_names))
    for k, part in enumerate(search.parts):
        weight = np.exp((result.marginals[k].min() - result.marginals[k]) / CONFIDENCE_TEMPERATURE)
        places = search.joint_points(k, scored[k].particles, target.mirror)
        part_joints = model.part_joints[part]
        for index, joint in list(enumerate(part_joints))[0 if k == 0 else 1 :]:
            distance = np.hypot(*(places[:, index] - joints[joint]).T)
            confidence[joint] = weight[distance <= AGREEMENT_RADIUS_M * target.scale].sum() / weight.sum()
    return confidence


def _select_diverse_wrists(
    search: PoseSearch, k: int, scored: ScoredPartParticles, result: MaxProduct, target: SearchTarget, count: int
) -> list[int]:
    """Select particles of a lower arm whose wrists together are near most of the weight, the best pose's first."""
    wrist = search.joint_points(k, scored.particles, target.mirror)[:, 1]
    weight = np.exp((result.marginals[k].min() - result.marginals[k]) / MODE_TEMPERATURE)
    squared = ((wrist[:, None] - wrist[None]) ** 2).sum(axis=2) / (WRIST_SD_M * target.scale) ** 2
    near = np.exp(-0.5 * squared)
    chosen = [int(result.assignment[k])]
    covered = near[chosen[0]].copy()
    while len(chosen) < min(count, len(wrist)):
        gain = (weight * np.maximum(near - covered, 0.0)).sum(axis=1)
        gain[chosen] = -1.0
        chosen.append(int(gain.argmax()))
        covered = np.maximum(covered, near[chosen[-1]])
    return chosen


def _make_mode(
    model: DeformableStructures,
    search: PoseSearch,
    scored: list[ScoredPartParticles],
    assignment: Array,
    cost: float,
    target: SearchTarget,
) -> PoseMode:
    """Return the joints of the chosen particles; where two parts meet, the middle of their ends."""
    total, count = np.zeros((len(model.joint_names), 2)), np.zeros(len(model.joint_names))
    scales = []
    for k, part in enumerate(search.parts):
        chosen = scored[k].particles.take(assignment[k : k + 1])
        part_joints = list(model.part_joints[part])
        total[part_joints] += search.joint_points(k, chosen, target.mirror)[0]
        count[part_joints] += 1
        scales.append(float(chosen.scale[0]))
    joints = np.full_like(total, np.nan)
    joints[count > 0] = total[count > 0] / count[count > 0, None]
    return PoseMode(joints, cost, float(np.exp(np.mean(np.log(scales)))))


def select_parts(model: DeformableStructures, known: Array) -> tuple[int, ...]:
    """Return the parts whose far joint is `known` (J,), with all their ancestors; the torso in any case."""
    wanted = {0}
    for part, name in enumerate(model.tree.names):
        if known[model.joint_names.index(PART_JOINTS[name][1])]:
            while part >= 0:
                wanted.add(part)
                part = model.tree.parents[part]
    return tuple(sorted(wanted))
