# SPDX-License-Identifier: Apache-2.0
"""The search for a body in a cloud: diverse particle max-product over the Stitched Puppet's parts (D-PMP)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.search.energy import JointTargets, ScoredParticles, stitching_costs
from flowing_puppet_ros.body.search.levenberg import levenberg_marquardt
from flowing_puppet_ros.body.search.part_points import PartPoints
from flowing_puppet_ros.body.search.particles import Particles, particles_to_state
from flowing_puppet_ros.body.search.proposals import Proposer
from flowing_puppet_ros.body.search.schedule import Stage, four_stages
from flowing_puppet_ros.evidence.cloud.data_term import CloudGrid
from flowing_puppet_ros.inference.diverse import select_diverse
from flowing_puppet_ros.inference.max_product import MaxProduct, max_product, message_foundation
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.process.threads import parallel_map

EXCLUDED_COST = 1e6  # of a particle that must not be used
NO_GRIDS: Mapping[int, CloudGrid] = {}  # every part is compared with the whole cloud


@dataclass(frozen=True, slots=True)
class SearchWeights:
    """Constants of the energy and of the selection.

    Attributes:
        stitch: factor of squared gaps in metres; the thesis's alphas alone let parts drift apart.
        mismatch: cost of a part with all normals contradicting the cloud's (eta of Eq. 52, per fraction of normals).
        temperature: of the diverse selection.
        neighbours: probability that a new particle is proposed by a neighbour.
        lm_steps: Levenberg-Marquardt steps per new particle.
        lm_points: surface points per part that those steps use.
    """

    stitch: float = 4.0
    mismatch: float = 0.3
    temperature: float = 0.1
    neighbours: float = 0.5
    lm_steps: int = 4
    lm_points: int = 60


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """The result of a search.

    Attributes:
        state: the best body.
        cost: Eq. 50 with the weights of the last stage.
        scored: the last particles of every part.
    """

    state: BodyState
    cost: float
    scored: list[ScoredParticles]


@dataclass(frozen=True, slots=True, eq=False)
class _SearchContext:
    """What all iterations of one search share: the cloud of every part, joint targets, and the number of threads."""

    grids: list[CloudGrid]
    targets: JointTargets
    threads: int


class BodyParticleSearch:
    """D-PMP for one model; one instance serves any number of clouds."""

    def __init__(self, model: StitchedPuppet, points: tuple[PartPoints, ...], weights: SearchWeights) -> None:
        self._model = model
        self._points = points
        self._weights = weights
        self._proposer = Proposer(model, points)

    def optimise(
        self,
        start: list[Particles],
        grid: CloudGrid,
        targets: JointTargets,
        stages: tuple[Stage, ...],
        iterations: int,
        rng: np.random.Generator,
        progress: Callable[[float], None] | None = None,
        part_grids: Mapping[int, CloudGrid] = NO_GRIDS,
        max_particles: int | None = None,
        threads: int = 1,
    ) -> SearchResult:
        """Improve particles by D-PMP and return the best body.

        Args:
            start: the first particles of each part; a part with a single one stays as it is.
            grid: the cloud.
            targets: joint targets.
            stages: schedule; the last stage ends at 1.
            iterations: rounds of proposing and selecting.
            rng: source of all randomness.
            progress: called with the fraction done, 0 to 1.
            part_grids: clouds of the parts that are not compared with `grid`.
            max_particles: particles per part to keep once all of the start were improved; None keeps their number.
            threads: number of threads; the result does not depend on it.
        """
        context = _SearchContext([part_grids.get(part, grid) for part in range(len(start))], targets, threads)
        scored = [
            ScoredParticles.score(points, particles, grid, targets)
            for points, particles, grid in zip(self._points, start, context.grids, strict=True)
        ]
        searched = [part for part, particles in enumerate(start) if len(particles) > 1]
        counts = [len(group) if max_particles is None else min(max_particles, len(group)) for group in start]
        if max_particles is not None:
            proposed = {part: start[part] for part in searched}
            scored = self._improve_and_select(scored, proposed, counts, stages[0], context)
        best = self._solve(scored, stages[0])[0].assignment
        for iteration in range(iterations):
            stage = next(stage for stage in stages if iteration < stage.until * iterations or stage is stages[-1])
            proposed = {part: self._propose(part, scored, best, stage, rng) for part in searched}
            scored = self._improve_and_select(scored, proposed, counts, stage, context)
            best = np.zeros(len(scored), dtype=np.int64)
            if progress is not None:
                progress((iteration + 1) / iterations)
        result, _ = self._solve(scored, stages[-1])
        return SearchResult(self._assemble_body(scored, result), result.cost, scored)

    def extract_modes(self, found: SearchResult, part: int) -> list[BodyState]:
        """Return the best body with each of the particles of `part` that a search kept."""
        nodes, edges = self._compute_costs(found.scored, four_stages(self._model.tree)[-1])
        bodies = []
        for particle in range(len(nodes[part])):
            only = np.full(len(nodes[part]), EXCLUDED_COST)
            only[particle] = nodes[part][particle]
            costs = [*nodes[:part], only, *nodes[part + 1 :]]
            bodies.append(self._assemble_body(found.scored, max_product(self._model.tree, costs, edges)))
        return bodies

    def _assemble_body(self, scored: list[ScoredParticles], result: MaxProduct) -> BodyState:
        return particles_to_state(self._model, [group.particles for group in scored], result.assignment)

    def _improve_and_select(
        self,
        scored: list[ScoredParticles],
        proposed: dict[int, Particles],
        counts: list[int],
        stage: Stage,
        context: _SearchContext,
    ) -> list[ScoredParticles]:
        """Improve the proposed particles, add them to the present ones, and keep `counts` of each part."""
        improved = parallel_map(
            lambda pair: self._improve(*pair, context.grids[pair[0]], context.targets),
            proposed.items(),
            context.threads,
        )
        scored = list(scored)
        for part, new in zip(proposed, improved, strict=True):
            scored[part] = scored[part].extend(new)
        result, edges = self._solve(scored, stage)
        for part in proposed:
            scored[part] = scored[part].take(self._select(part, counts[part], result, edges, stage.greedy))
        return scored

    def _propose(
        self, part: int, scored: list[ScoredParticles], best: np.ndarray, stage: Stage, rng: np.random.Generator
    ) -> Particles:
        if stage.greedy:
            copies = scored[part].particles.take(np.full(len(scored[part].particles), best[part]))
            return self._proposer.random_walk(copies, stage.noise, rng, deformation_only=0.5)
        return self._proposer.propose(part, scored, stage.noise, self._weights.neighbours, rng)

    def _improve(self, part: int, new: Particles, grid: CloudGrid, targets: JointTargets) -> ScoredParticles:
        improved = levenberg_marquardt(
            self._points[part], new, grid, targets, self._weights.lm_steps, self._weights.lm_points
        )
        return ScoredParticles.score(self._points[part], improved, grid, targets)

    def _solve(self, scored: list[ScoredParticles], stage: Stage) -> tuple[MaxProduct, list[np.ndarray]]:
        """Run max-product with the weights of a stage."""
        nodes, edges = self._compute_costs(scored, stage)
        return max_product(self._model.tree, nodes, edges), edges

    def _compute_costs(self, scored: list[ScoredParticles], stage: Stage) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return the costs of each part's particles and of each edge's pairs, weighted as in a stage (Eqs. 50-52)."""
        nodes = [
            beta * (group.distance + self._weights.mismatch * group.mismatch) + group.joint_cost
            for beta, group in zip(stage.data, scored, strict=True)
        ]
        edges = []
        for edge, (parent, child) in enumerate(self._model.tree.edges):
            a, b = scored[parent], scored[child]
            centers = a.particles.center, b.particles.center
            weight = self._model.interfaces[edge].weight
            cost = stitching_costs(weight, a.interfaces[edge], b.interfaces[edge], centers, self._weights.stitch)
            edges.append(stage.stitch[edge] * cost)
        return nodes, edges

    def _select(self, part: int, count: int, result: MaxProduct, edges: list[np.ndarray], greedy: bool) -> np.ndarray:
        """Return the indices of the particles to keep, that of the best body first."""
        best = int(result.assignment[part])
        if greedy:
            order = np.argsort(result.marginals[part], kind="stable")
            return np.concatenate([[best], order[order != best][: count - 1]])
        foundation = message_foundation(self._model.tree, edges, result, part)
        return select_diverse(foundation, count, best, self._weights.temperature)
