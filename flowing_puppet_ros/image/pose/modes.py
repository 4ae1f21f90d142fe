# SPDX-License-Identifier: Apache-2.0
"""From the last particles to answers: the best pose, others that differ in their arms, and how sure each joint is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.image.pose.particle_search import PoseSearch, ScoredParticles, SearchTarget
from flowing_puppet_ros.inference.max_product import MaxProduct, max_product
from flowing_puppet_ros.model.ds.joints import PART_JOINTS
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

APART = 0.15
"""Distance in metres at which two hypotheses of a wrist are different ones."""

NEAR = 0.1
"""Metres within which other particles agree with a joint."""

EVENNESS = 15.0
"""Cost difference at which a hypothesis counts 1/e of the best one when diverse ones are chosen."""

DOUBT = 15.0
"""Cost difference at which a particle counts 1/e of the best one in a joint's confidence."""

_FORBIDDEN = 1e9


@dataclass(frozen=True, slots=True, eq=False)
class PoseMode:
    """One pose: joints (J,2) px, NaN where nothing was searched, its energy in nats, and scale px/m."""

    joints: Array
    energy: float
    scale: float


def extract_modes(
    model: DeformableStructures, search: PoseSearch, judged: list[ScoredParticles], person: SearchTarget, count: int
) -> list[PoseMode]:
    """Up to `count` poses that differ in their arms: the best of all first, then in the order of their energy.

    The k-th hypothesis of the right wrist goes with the k-th of the left one; the rest is the best for both.
    """
    result, edges = search.solve(judged)
    arms = [k for k, name in enumerate(search.tree.names) if name.endswith("lower_arm")]
    choices = {k: _hypotheses(search, k, judged[k], result, person, count) for k in arms}
    solutions = [_solution(model, search, judged, result.assignment, result.cost, person)]
    for turn in range(1, max((len(chosen) for chosen in choices.values()), default=0)):
        costs = [group.cost.copy() for group in judged]
        for k, chosen in choices.items():
            pinned = chosen[min(turn, len(chosen) - 1)]
            costs[k] += _FORBIDDEN
            costs[k][pinned] -= _FORBIDDEN
        other = max_product(search.tree, costs, edges)
        solutions.append(_solution(model, search, judged, other.assignment, other.cost, person))
    return [solutions[0], *sorted(solutions[1:], key=lambda one: one.energy)]


def joint_confidence(
    model: DeformableStructures,
    search: PoseSearch,
    judged: list[ScoredParticles],
    result: MaxProduct,
    person: SearchTarget,
    at: Array,
) -> Array:
    """Share (J,) of the particles' weight, by max-marginal, whose joint lies near that of `at` (J,2); 0 unsearched."""
    confidence = np.zeros(len(model.joint_names))
    for k, part in enumerate(search.parts):
        weight = np.exp((result.marginals[k].min() - result.marginals[k]) / DOUBT)
        places = search.joints(k, judged[k].particles, person.mirror)
        own = model.part_joints[part]
        for index, joint in list(enumerate(own))[0 if k == 0 else 1 :]:
            apart = np.hypot(*(places[:, index] - at[joint]).T)
            confidence[joint] = weight[apart <= NEAR * person.scale].sum() / weight.sum()
    return confidence


def _hypotheses(
    search: PoseSearch, k: int, judged: ScoredParticles, result: MaxProduct, person: SearchTarget, count: int
) -> list[int]:
    """Particles of a lower arm whose wrists together lie near most of the weight; that of the best pose first."""
    wrist = search.joints(k, judged.particles, person.mirror)[:, 1]
    weight = np.exp((result.marginals[k].min() - result.marginals[k]) / EVENNESS)
    squared = ((wrist[:, None] - wrist[None]) ** 2).sum(axis=2) / (APART * person.scale) ** 2
    near = np.exp(-0.5 * squared)
    chosen = [int(result.assignment[k])]
    covered = near[chosen[0]].copy()
    while len(chosen) < min(count, len(wrist)):
        gain = (weight * np.maximum(near - covered, 0.0)).sum(axis=1)
        gain[chosen] = -1.0
        chosen.append(int(gain.argmax()))
        covered = np.maximum(covered, near[chosen[-1]])
    return chosen


def _solution(
    model: DeformableStructures,
    search: PoseSearch,
    judged: list[ScoredParticles],
    assignment: Array,
    cost: float,
    person: SearchTarget,
) -> PoseMode:
    """Joints of the chosen particles; where two parts meet, the middle of their ends."""
    total, count = np.zeros((len(model.joint_names), 2)), np.zeros(len(model.joint_names))
    scales = []
    for k, part in enumerate(search.parts):
        chosen = judged[k].particles.take(assignment[k : k + 1])
        own = list(model.part_joints[part])
        total[own] += search.joints(k, chosen, person.mirror)[0]
        count[own] += 1
        scales.append(float(chosen.scale[0]))
    joints = np.full_like(total, np.nan)
    joints[count > 0] = total[count > 0] / count[count > 0, None]
    return PoseMode(joints, cost, float(np.exp(np.mean(np.log(scales)))))


def searched_parts(model: DeformableStructures, known: Array) -> tuple[int, ...]:
    """Parts whose far joint is known (J,), with all that they hang from; the torso in any case."""
    wanted = {0}
    for part, name in enumerate(model.tree.names):
        if known[model.joint_names.index(PART_JOINTS[name][1])]:
            while part >= 0:
                wanted.add(part)
                part = model.tree.parents[part]
    return tuple(sorted(wanted))
