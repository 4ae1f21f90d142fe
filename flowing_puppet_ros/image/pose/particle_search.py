# SPDX-License-Identifier: Apache-2.0
"""Particle max-product for the 2D puppet on one person (thesis, "Human Pose Estimation from Single Images").

New particles come from a random walk, from neighbours through the conditional Gaussians of the model, and from the
image: wrists are drawn where hands are likely, and whole arms laid to them. Selection is that of D-PMP; at the end
the best pose alone is refined by plain particle max-product.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.image.pose.evidence import PersonHypotheses, PersonWindow
from flowing_puppet_ros.image.pose.particles import PairwiseGaussian, Particles, clip_shape, joint_rows, world_points
from flowing_puppet_ros.image.pose.settings import PoseSettings
from flowing_puppet_ros.inference.diverse import select_diverse
from flowing_puppet_ros.inference.max_product import MaxProduct, max_product, message_foundation
from flowing_puppet_ros.model.ds.joints import PART_JOINTS
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.tree import PartTree

SHIFT, TURN, GROW, DEFORM = 0.02, 0.12, 0.03, 0.35
"""Deviations of a step of the random walk: metres, radians, share of the scale, shape coefficients."""

PERSON_SCALE = 0.15
"""Deviation of a torso's scale from the one that the person was found at, as a share."""

WRIST_WEIGHT = 2.0
"""Weight of the detector's score of wrists relative to other joints: their maps know most of the whole arm."""

GRID = 0.04  # metres between the places at which wrists are considered
REACH = 0.8  # metres from the shoulder


@dataclass(frozen=True, slots=True, eq=False)
class ScoredParticles:
    """Particles of one part with their own cost (P,): evidence and, for the torso, prior."""

    particles: Particles
    cost: Array

    def take(self, chosen: Array) -> ScoredParticles:
        """The particles with these indices."""
        return ScoredParticles(self.particles.take(chosen), self.cost[chosen])


@dataclass(frozen=True, slots=True, eq=False)
class SearchTarget:
    """What is searched for: evidence `scene`, detection `found`, `scale` px/m and signs `mirror` (2,) of the axes."""

    scene: PersonWindow | None
    found: PersonHypotheses
    scale: float
    mirror: Array


class PoseSearch:
    """The search over the parts `parts` (indices, torso first) of one model; serves any number of people."""

    def __init__(self, model: DeformableStructures, parts: tuple[int, ...], settings: PoseSettings) -> None:
        """`parts` must hold the parent of every part but the torso."""
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
        self._joints = [PART_JOINTS[name] if name == "torso" else PART_JOINTS[name][1:2] for name in names]

    def run(
        self, start: list[Particles], person: SearchTarget, rng: np.random.Generator
    ) -> tuple[list[ScoredParticles], MaxProduct]:
        """Improve the particles `start` of every part; returns the last ones and max-product over them."""
        judged = [self._score(k, self._flattened(group), person) for k, group in enumerate(start)]
        settings = self._settings
        judged = self._improve(judged, person, rng, settings.iterations, settings.diverse)
        # Particles spread over many poses leave few for the best one: it is refined apart, and no other pose is lost.
        fine = self._improve(judged, person, rng, settings.refinements, diverse=False)
        best = self.solve(fine)[0].assignment
        judged = [_joined(judged[k], fine[k].take(best[k : k + 1])) for k in range(len(judged))]
        return judged, self.solve(judged)[0]

    def best_contours(self, start: list[Particles], person: SearchTarget, names: tuple[str, ...]) -> list[Array]:
        """Contours (K,2) px of the parts `names` in the best configuration of some particles."""
        judged = [self._score(k, self._flattened(group), person) for k, group in enumerate(start)]
        result, _ = self.solve(judged)
        best = []
        for name in names:
            k = self.tree.index(name)
            chosen = judged[k].particles.take(result.assignment[k : k + 1])
            best.append(world_points(self.shapes[k], chosen)[0, : -self.shapes[k].joint_count] * person.mirror)
        return best

    def energy(self, puppet: list[Particles], person: SearchTarget) -> float:
        """Energy in nats of one puppet, given as one particle for every part of the model."""
        return self.solve([self._score(k, puppet[part], person) for k, part in enumerate(self.parts)])[0].cost

    def solve(self, judged: list[ScoredParticles]) -> tuple[MaxProduct, list[Array]]:
        """Max-product over the particles, and the costs of the edges."""
        spread = self._settings.scale_deviation
        edges = [
            edge.costs(judged[i].particles, judged[j].particles, spread)
            for edge, (i, j) in zip(self._edges, self.tree.edges, strict=True)
        ]
        return max_product(self.tree, [group.cost for group in judged], edges), edges

    def joints(self, k: int, particles: Particles, mirror: Array) -> Array:
        """Joint points (P,M,2) px of part `k`, in the image."""
        return world_points(self.shapes[k], particles, joint_rows(self.shapes[k])) * mirror

    def _score(self, k: int, particles: Particles, person: SearchTarget) -> ScoredParticles:
        cost = np.zeros(len(particles))
        if k == 0:
            ratio = np.log(particles.scale / person.scale) / PERSON_SCALE
            cost += 0.5 * (particles.shape**2).sum(axis=1) + 0.5 * ratio**2
        settings = self._settings
        if not settings.likelihood:
            return ScoredParticles(particles, cost)
        if person.scene is not None:
            contours = world_points(self.shapes[k], particles)[:, : -self.shapes[k].joint_count] * person.mirror
            likelihood = person.scene.log_likelihood(self.parts[k], np.ascontiguousarray(contours), particles.scale)
            cost -= settings.evidence_weight * likelihood
        places = self.joints(k, particles, person.mirror)[:, -len(self._joints[k]) :]
        for index, name in enumerate(self._joints[k]):
            score = person.found.joint_score(name, np.ascontiguousarray(places[:, index]))
            weight = settings.detector_weight * (WRIST_WEIGHT if name.endswith("wrist") else 1.0)
            cost -= weight / len(self._joints[k]) * score
        return ScoredParticles(particles, cost)

    def _improve(
        self, judged: list[ScoredParticles], person: SearchTarget, rng: np.random.Generator, rounds: int, diverse: bool
    ) -> list[ScoredParticles]:
        """The particles that are left after so many rounds of proposing and selecting."""
        for _ in range(rounds):
            proposed = self._propose(judged, person, rng)
            new = [self._score(k, self._flattened(group), person) for k, group in enumerate(proposed)]
            judged = [_joined(*pair) for pair in zip(judged, new, strict=True)]
            result, edges = self.solve(judged)
            judged = [group.take(self._select(k, result, edges, diverse)) for k, group in enumerate(judged)]
        return judged

    def _flattened(self, particles: Particles) -> Particles:
        """The particles as they are, or with the mean shape where shapes may not vary."""
        if self._settings.shape:
            return particles
        return Particles(particles.center, particles.angle, particles.scale, np.zeros_like(particles.shape))

    def _select(self, k: int, result: MaxProduct, edges: list[Array], diverse: bool) -> Array:
        kept = int(result.assignment[k])
        count = min(self._settings.particles, len(result.marginals[k]))
        if diverse:
            foundation = message_foundation(self.tree, edges, result, k)
            return select_diverse(foundation, count, kept, self._settings.temperature)
        order = np.argsort(result.marginals[k], kind="stable")
        return np.concatenate([[kept], order[order != kept][: count - 1]])

    def _propose(
        self, judged: list[ScoredParticles], person: SearchTarget, rng: np.random.Generator
    ) -> list[Particles]:
        count = self._settings.particles
        groups = [[self._walk(k, judged[k].particles, count // 3, rng)] for k in range(len(judged))]
        for k in range(len(judged)):
            groups[k] += self._from_neighbours(k, judged, count // 3, rng)
        for side in ("right", "left"):
            if f"{side}_lower_arm" in self.tree.names:
                self._propose_arms_from_wrists(side, groups, judged, person, count // 3, rng)
        return [Particles.join(group) for group in groups]

    def _walk(self, k: int, particles: Particles, count: int, rng: np.random.Generator) -> Particles:
        """Steps of the random walk; limbs turn about the joint they hang from."""
        old = particles.take(rng.integers(len(particles), size=count))
        row = joint_rows(self.shapes[k])[:1]
        pivot = world_points(self.shapes[k], old, row)[:, 0]
        step = rng.standard_normal((count, 4))
        # Half of the steps change the shape alone, so that a good place is not lost with it.
        moves = (np.arange(count) % 2).astype(float)
        shape = clip_shape(old.shape + DEFORM * rng.standard_normal(old.shape.shape))
        scale = old.scale * np.exp(GROW * step[:, 2] * moves)
        moved = Particles(old.center, old.angle + TURN * step[:, 3] * moves, scale, shape)
        drift = pivot - world_points(self.shapes[k], moved, row)[:, 0]
        drift += SHIFT * (scale * moves)[:, None] * step[:, :2]
        return Particles(moved.center + drift, moved.angle, moved.scale, moved.shape)

    def _from_neighbours(
        self, k: int, judged: list[ScoredParticles], count: int, rng: np.random.Generator
    ) -> list[Particles]:
        """Particles drawn given those of one neighbour, or of the parent and one child."""
        neighbours = self.tree.neighbours(k)
        groups = []
        for turn, other in enumerate(neighbours):
            share = count // len(neighbours) + (turn < count % len(neighbours))
            chosen = judged[other].particles.take(rng.integers(len(judged[other].particles), size=share))
            if other < k:
                groups.append(self._edges[k - 1].propose_child(chosen, rng))
            elif k == 0:
                groups.append(self._edges[other - 1].propose_parent(chosen, rng))
            else:
                above = judged[self.tree.parents[k]].particles
                parents = above.take(rng.integers(len(above), size=share))
                near = world_points(self.shapes[other], chosen, joint_rows(self.shapes[other])[:1])[:, 0]
                groups.append(self._edges[k - 1].propose_between(parents, near, rng))
        return groups

    def _propose_arms_from_wrists(
        self,
        side: str,
        groups: list[list[Particles]],
        judged: list[ScoredParticles],
        person: SearchTarget,
        count: int,
        rng: np.random.Generator,
    ) -> None:
        """Bottom-up proposals: wrists where the image may show hands, and arms that reach there."""
        upper, lower = self.tree.index(f"{side}_upper_arm"), self.tree.index(f"{side}_lower_arm")
        torsos = judged[0].particles.take(rng.integers(len(judged[0].particles), size=count))
        row = joint_rows(self.shapes[0])[PART_JOINTS["torso"].index(f"{side}_shoulder")]
        shoulder = world_points(self.shapes[0], torsos, np.array([row]))[:, 0]
        wrist = self._draw_wrists(side, shoulder[0], person, count, rng)
        lengths = [np.ptp(self.shapes[k].mean[joint_rows(self.shapes[k]), 0]) for k in (upper, lower)]
        elbow = elbows(shoulder, wrist, lengths[0] * torsos.scale, lengths[1] * torsos.scale, rng)
        arms = self._edges[upper - 1].propose_between(torsos, elbow, rng)
        groups[upper].append(arms)
        groups[lower].append(self._edges[lower - 1].propose_between(arms, wrist, rng))

    def _draw_wrists(
        self, side: str, shoulder: Array, person: SearchTarget, count: int, rng: np.random.Generator
    ) -> Array:
        """Places (count,2) drawn in proportion to the likelihood of hands and to the detector's score of wrists."""
        ticks = np.arange(-REACH, REACH + GRID / 2, GRID) * person.scale
        grid = shoulder + np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
        inside = ((grid - shoulder) ** 2).sum(axis=1) <= (REACH * person.scale) ** 2
        grid = grid[inside]
        score = np.zeros(len(grid))
        if self._settings.likelihood:
            score = self._settings.detector_weight * person.found.joint_score(f"{side}_wrist", grid * person.mirror)
            if person.scene is not None:
                score += np.log(person.scene.hands(grid * person.mirror, person.scale))
        weight = np.exp((score - score.max()) / self._settings.temperature)
        chosen = rng.choice(len(grid), size=count, p=weight / weight.sum())
        return np.asarray(grid[chosen] + (rng.random((count, 2)) - 0.5) * GRID * person.scale)


def elbows(shoulder: Array, wrist: Array, upper: Array, lower: Array, rng: np.random.Generator) -> Array:
    """Elbows (P,2) between shoulders and wrists (P,2): an arm of lengths `upper`, `lower` (P,) bent to a random side.

    An arm that cannot reach the wrist lies straight; one whose wrist is too near is foreshortened.
    """
    reach = wrist - shoulder
    distance = np.maximum(np.hypot(reach[:, 0], reach[:, 1]), 1e-6)
    # Bones are drawn shorter as they point towards the camera or away from it.
    shrink = np.where(rng.random(len(distance)) < 0.5, 1.0, rng.uniform(0.5, 1.0, len(distance)))
    upper, lower = upper * shrink, lower * shrink
    along = np.clip((distance**2 + upper**2 - lower**2) / (2 * distance), -upper, upper)
    along = np.where(upper + lower < distance, distance * upper / (upper + lower), along)
    across = np.sqrt(np.maximum(upper**2 - along**2, 0.0)) * np.where(upper + lower < distance, 0.0, 1.0)
    axis = reach / distance[:, None]
    sign = rng.choice([-1.0, 1.0], size=len(distance))
    sideways = np.stack([-axis[:, 1], axis[:, 0]], axis=1)
    return np.asarray(shoulder + axis * along[:, None] + sideways * (sign * across)[:, None])


def _joined(first: ScoredParticles, second: ScoredParticles) -> ScoredParticles:
    particles = Particles.join([first.particles, second.particles])
    return ScoredParticles(particles, np.concatenate([first.cost, second.cost]))
