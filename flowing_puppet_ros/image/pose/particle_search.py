# SPDX-License-Identifier: Apache-2.0
"""Particle max-product for the 2D puppet on one person (thesis, "Human Pose Estimation from Single Images").

New particles come from a random walk, from neighbours through the conditional Gaussians of the model, and from the
image: wrists are drawn where hands are likely, and whole arms are placed to reach them. Selection is that of D-PMP. At
the end the best pose alone is refined by plain particle max-product.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.image.pose.evidence import PersonHypotheses, PersonWindow
from flowing_puppet_ros.image.pose.particles import (
    PairwiseGaussian,
    PartParticles,
    clip_shape,
    joint_rows,
    world_points,
)
from flowing_puppet_ros.image.pose.settings import PoseSettings
from flowing_puppet_ros.inference.diverse import select_diverse
from flowing_puppet_ros.inference.max_product import MaxProduct, max_product, message_foundation
from flowing_puppet_ros.model.ds.joints import PART_JOINTS
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.tree import PartTree

WALK_SHIFT_M, WALK_ANGLE_RAD, WALK_SCALE, WALK_SHAPE = 0.02, 0.12, 0.03, 0.35
"""Standard deviations of a step of the random walk; of the scale in its logarithm, of the shape in coefficients."""

TORSO_SCALE_SD = 0.15
"""Standard deviation of the logarithm of a torso's scale from that of the detection."""

WRIST_WEIGHT = 2.0
"""Weight of the detector's score of wrists relative to other joints: it says most about the whole arm."""

WRIST_GRID_M = 0.04  # between the places at which wrists are proposed
WRIST_REACH_M = 0.8  # maximum distance of a proposed wrist from the shoulder


@dataclass(frozen=True, slots=True, eq=False)
class ScoredPartParticles:
    """Particles of one part with their own `cost` (P,): evidence and, for the torso, prior."""

    particles: PartParticles
    cost: Array

    def take(self, chosen: Array) -> ScoredPartParticles:
        """Return the particles with these indices."""
        return ScoredPartParticles(self.particles.take(chosen), self.cost[chosen])


@dataclass(frozen=True, slots=True, eq=False)
class SearchTarget:
    """The person to search: evidence, the detector's hypotheses, `scale` px/m and signs `mirror` (2,) of the axes."""

    window: PersonWindow | None
    hypotheses: PersonHypotheses
    scale: float
    mirror: Array


class PoseSearch:
    """Search over the parts `parts` (indices, torso first) of one model; serves any number of people."""

    def __init__(self, model: DeformableStructures, parts: tuple[int, ...], settings: PoseSettings) -> None:
        """Prepare the edges; `parts` must hold the parent of every part but the torso."""
        names = tuple(model.tree.names[part] for part in parts)
        parents = tuple(parts.index(model.tree.parents[part]) if part else -1 for part in parts)
        self.tree = PartTree(names, parents)
        self.parts = parts
        self._settings = settings
        self.shapes = [model.shapes[part] for part in parts]
        self._edges = []
        for i, j in self.tree.edges:
            shared = PART_JOINTS[names[i]].index(PART_JOINTS[names[j]][0])
            row = int(joint_rows(self.shapes[i])[shared])
            pair = model.pairwise[parts[j] - 1]
            self._edges.append(PairwiseGaussian(pair, self.shapes[i], self.shapes[j], row, settings.spring))
        self._scored_joints = [PART_JOINTS[name] if name == "torso" else PART_JOINTS[name][1:2] for name in names]

    def run(
        self, start: list[PartParticles], target: SearchTarget, rng: np.random.Generator
    ) -> tuple[list[ScoredPartParticles], MaxProduct]:
        """Improve the particles `start` of every part; return the last ones and max-product over them."""
        scored = [self._score(k, self._flatten_shapes(group), target) for k, group in enumerate(start)]
        settings = self._settings
        scored = self._improve(scored, target, rng, settings.iterations, settings.diverse)
        # Particles spread over many poses leave few for the best one: it is refined apart, and no other pose is lost.
        fine = self._improve(scored, target, rng, settings.refinements, diverse=False)
        best = self.solve(fine)[0].assignment
        scored = [_join(scored[k], fine[k].take(best[k : k + 1])) for k in range(len(scored))]
        return scored, self.solve(scored)[0]

    def find_best_contours(
        self, start: list[PartParticles], target: SearchTarget, names: tuple[str, ...]
    ) -> list[Array]:
        """Return the contours (K, 2) px of the parts `names` in the best configuration of some particles."""
        scored = [self._score(k, self._flatten_shapes(group), target) for k, group in enumerate(start)]
        result, _ = self.solve(scored)
        best = []
        for name in names:
            k = self.tree.index(name)
            chosen = scored[k].particles.take(result.assignment[k : k + 1])
            best.append(world_points(self.shapes[k], chosen)[0, : -self.shapes[k].joint_count] * target.mirror)
        return best

    def energy(self, puppet: list[PartParticles], target: SearchTarget) -> float:
        """Return the energy of one puppet in nats (-log of Eq. 15), given as one particle per part of the model."""
        return self.solve([self._score(k, puppet[part], target) for k, part in enumerate(self.parts)])[0].cost

    def solve(self, scored: list[ScoredPartParticles]) -> tuple[MaxProduct, list[Array]]:
        """Run max-product over the particles; return its result and the costs of the edges."""
        deviation = self._settings.scale_deviation
        edges = [
            edge.costs(scored[i].particles, scored[j].particles, deviation)
            for edge, (i, j) in zip(self._edges, self.tree.edges, strict=True)
        ]
        return max_product(self.tree, [group.cost for group in scored], edges), edges

    def joint_points(self, k: int, particles: PartParticles, mirror: Array) -> Array:
        """Return the joint points (P, M, 2) px of part `k` in the image."""
        return world_points(self.shapes[k], particles, joint_rows(self.shapes[k])) * mirror

    def _score(self, k: int, particles: PartParticles, target: SearchTarget) -> ScoredPartParticles:
        cost = np.zeros(len(particles))
        if k == 0:
            ratio = np.log(particles.scale / target.scale) / TORSO_SCALE_SD
            cost += 0.5 * (particles.shape**2).sum(axis=1) + 0.5 * ratio**2
        settings = self._settings
        if not settings.likelihood:
            return ScoredPartParticles(particles, cost)
        if target.window is not None:
            contours = world_points(self.shapes[k], particles)[:, : -self.shapes[k].joint_count] * target.mirror
            likelihood = target.window.log_likelihood(self.parts[k], np.ascontiguousarray(contours), particles.scale)
            cost -= settings.evidence_weight * likelihood
        places = self.joint_points(k, particles, target.mirror)[:, -len(self._scored_joints[k]) :]
        for index, name in enumerate(self._scored_joints[k]):
            score = target.hypotheses.joint_score(name, np.ascontiguousarray(places[:, index]))
            weight = settings.detector_weight * (WRIST_WEIGHT if name.endswith("wrist") else 1.0)
            share = 1 if target.hypotheses.joints_are_independent else len(self._scored_joints[k])
            cost -= weight / share * score
        return ScoredPartParticles(particles, cost)

    def _improve(
        self,
        scored: list[ScoredPartParticles],
        target: SearchTarget,
        rng: np.random.Generator,
        rounds: int,
        diverse: bool,
    ) -> list[ScoredPartParticles]:
        """Return the particles after `rounds` of proposing and selecting."""
        for _ in range(rounds):
            proposed = self._propose(scored, target, rng)
            new = [self._score(k, self._flatten_shapes(group), target) for k, group in enumerate(proposed)]
            scored = [_join(*pair) for pair in zip(scored, new, strict=True)]
            result, edges = self.solve(scored)
            scored = [group.take(self._select(k, result, edges, diverse)) for k, group in enumerate(scored)]
        return scored

    def _flatten_shapes(self, particles: PartParticles) -> PartParticles:
        """Give the particles the mean shape if shapes may not vary."""
        if self._settings.shape:
            return particles
        return PartParticles(particles.center, particles.angle, particles.scale, np.zeros_like(particles.shape))

    def _select(self, k: int, result: MaxProduct, edges: list[Array], diverse: bool) -> Array:
        kept = int(result.assignment[k])
        count = min(self._settings.particles, len(result.marginals[k]))
        if diverse:
            foundation = message_foundation(self.tree, edges, result, k)
            return select_diverse(foundation, count, kept, self._settings.temperature)
        order = np.argsort(result.marginals[k], kind="stable")
        return np.concatenate([[kept], order[order != kept][: count - 1]])

    def _propose(
        self, scored: list[ScoredPartParticles], target: SearchTarget, rng: np.random.Generator
    ) -> list[PartParticles]:
        count = self._settings.particles
        groups = [[self._walk_randomly(k, scored[k].particles, count // 3, rng)] for k in range(len(scored))]
        for k in range(len(scored)):
            groups[k] += self._propose_from_neighbours(k, scored, count // 3, rng)
        for side in ("right", "left"):
            if f"{side}_lower_arm" in self.tree.names:
                self._propose_arms_from_wrists(side, groups, scored, target, count // 3, rng)
        return [PartParticles.join(group) for group in groups]

    def _walk_randomly(self, k: int, particles: PartParticles, count: int, rng: np.random.Generator) -> PartParticles:
        """Propose steps of a random walk; limbs rotate about their proximal joint."""
        old = particles.take(rng.integers(len(particles), size=count))
        row = joint_rows(self.shapes[k])[:1]
        pivot = world_points(self.shapes[k], old, row)[:, 0]
        step = rng.standard_normal((count, 4))
        # Half of the steps change the shape alone, so that a good place is kept.
        moves = (np.arange(count) % 2).astype(float)
        shape = clip_shape(old.shape + WALK_SHAPE * rng.standard_normal(old.shape.shape))
        scale = old.scale * np.exp(WALK_SCALE * step[:, 2] * moves)
        moved = PartParticles(old.center, old.angle + WALK_ANGLE_RAD * step[:, 3] * moves, scale, shape)
        drift = pivot - world_points(self.shapes[k], moved, row)[:, 0]
        drift += WALK_SHIFT_M * (scale * moves)[:, None] * step[:, :2]
        return PartParticles(moved.center + drift, moved.angle, moved.scale, moved.shape)

    def _propose_from_neighbours(
        self, k: int, scored: list[ScoredPartParticles], count: int, rng: np.random.Generator
    ) -> list[PartParticles]:
        """Draw particles given those of one neighbour, or of the parent and one child."""
        neighbours = self.tree.neighbours(k)
        groups = []
        for number, other in enumerate(neighbours):
            share = count // len(neighbours) + (number < count % len(neighbours))
            chosen = scored[other].particles.take(rng.integers(len(scored[other].particles), size=share))
            if other < k:
                groups.append(self._edges[k - 1].propose_child(chosen, rng))
            elif k == 0:
                groups.append(self._edges[other - 1].propose_parent(chosen, rng))
            else:
                above = scored[self.tree.parents[k]].particles
                parents = above.take(rng.integers(len(above), size=share))
                near = world_points(self.shapes[other], chosen, joint_rows(self.shapes[other])[:1])[:, 0]
                groups.append(self._edges[k - 1].propose_between(parents, near, rng))
        return groups

    def _propose_arms_from_wrists(
        self,
        side: str,
        groups: list[list[PartParticles]],
        scored: list[ScoredPartParticles],
        target: SearchTarget,
        count: int,
        rng: np.random.Generator,
    ) -> None:
        """Add bottom-up proposals: wrists where the image may show hands, and arms that reach there."""
        upper, lower = self.tree.index(f"{side}_upper_arm"), self.tree.index(f"{side}_lower_arm")
        torsos = scored[0].particles.take(rng.integers(len(scored[0].particles), size=count))
        row = joint_rows(self.shapes[0])[PART_JOINTS["torso"].index(f"{side}_shoulder")]
        shoulder = world_points(self.shapes[0], torsos, np.array([row]))[:, 0]
        wrist = self._draw_wrists(side, shoulder[0], target, count, rng)
        lengths = [np.ptp(self.shapes[k].mean[joint_rows(self.shapes[k]), 0]) for k in (upper, lower)]
        elbow = place_elbows(shoulder, wrist, lengths[0] * torsos.scale, lengths[1] * torsos.scale, rng)
        arms = self._edges[upper - 1].propose_between(torsos, elbow, rng)
        groups[upper].append(arms)
        groups[lower].append(self._edges[lower - 1].propose_between(arms, wrist, rng))

    def _draw_wrists(
        self, side: str, shoulder: Array, target: SearchTarget, count: int, rng: np.random.Generator
    ) -> Array:
        """Draw places (count, 2) in proportion to the likelihood of hands and to the detector's score of wrists."""
        ticks = np.arange(-WRIST_REACH_M, WRIST_REACH_M + WRIST_GRID_M / 2, WRIST_GRID_M) * target.scale
        grid = shoulder + np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
        inside = ((grid - shoulder) ** 2).sum(axis=1) <= (WRIST_REACH_M * target.scale) ** 2
        grid = grid[inside]
        score = np.zeros(len(grid))
        if self._settings.likelihood:
            score = self._settings.detector_weight * target.hypotheses.joint_score(
                f"{side}_wrist", grid * target.mirror
            )
            if target.window is not None:
                score += np.log(target.window.score_hands(grid * target.mirror, target.scale))
        weight = np.exp((score - score.max()) / self._settings.temperature)
        chosen = rng.choice(len(grid), size=count, p=weight / weight.sum())
        return np.asarray(grid[chosen] + (rng.random((count, 2)) - 0.5) * WRIST_GRID_M * target.scale)


def place_elbows(shoulder: Array, wrist: Array, upper: Array, lower: Array, rng: np.random.Generator) -> Array:
    """Return elbows (P, 2) between shoulders and wrists (P, 2), for arms of lengths `upper` and `lower` (P,).

    The elbow bends to a random side. By the wrist's distance:
        out of reach      the arm is straight
        too near          the arm is foreshortened
    """
    reach = wrist - shoulder
    distance = np.maximum(np.hypot(reach[:, 0], reach[:, 1]), 1e-6)
    # Bones appear shorter when they point towards the camera or away from it.
    shrink = np.where(rng.random(len(distance)) < 0.5, 1.0, rng.uniform(0.5, 1.0, len(distance)))
    upper, lower = upper * shrink, lower * shrink
    along = np.clip((distance**2 + upper**2 - lower**2) / (2 * distance), -upper, upper)
    along = np.where(upper + lower < distance, distance * upper / (upper + lower), along)
    across = np.sqrt(np.maximum(upper**2 - along**2, 0.0)) * np.where(upper + lower < distance, 0.0, 1.0)
    axis = reach / distance[:, None]
    sign = rng.choice([-1.0, 1.0], size=len(distance))
    sideways = np.stack([-axis[:, 1], axis[:, 0]], axis=1)
    return np.asarray(shoulder + axis * along[:, None] + sideways * (sign * across)[:, None])


def _join(first: ScoredPartParticles, second: ScoredPartParticles) -> ScoredPartParticles:
    particles = PartParticles.join([first.particles, second.particles])
    return ScoredPartParticles(particles, np.concatenate([first.cost, second.cost]))
