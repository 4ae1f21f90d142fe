# SPDX-License-Identifier: Apache-2.0
"""The search for a body in a cloud: diverse particle max-product over the Stitched Puppet's parts (D-PMP)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.search.energy import JointTargets, ScoredParticles, stitching_costs
from flowing_puppet_ros.body.search.levenberg import levenberg_marquardt
from flowing_puppet_ros.body.search.part_points import PartPoints
from flowing_puppet_ros.body.search.particles import Particles, particles_to_state, states_to_particles
from flowing_puppet_ros.body.search.proposals import Proposer
from flowing_puppet_ros.body.search.schedule import Stage, four_stages
from flowing_puppet_ros.evidence.cloud.data_term import CloudGrid, DataCost
from flowing_puppet_ros.inference.diverse import select_diverse
from flowing_puppet_ros.inference.max_product import MaxProduct, max_product, message_foundation
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.parallel import parallel_map

EXCLUDED = 1e6  # cost of a particle that is not to be used
NO_GRIDS: Mapping[int, CloudGrid] = {}


@dataclass(frozen=True, slots=True)
class SearchWeights:
    """Constants of the energy and of the selection.

    Attributes:
        stitch: factor of squared gaps in metres; the thesis's alphas alone let parts drift apart.
        mismatch: cost of a part all of whose normals contradict the cloud's (eta of Eq. 52, per fraction).
        temperature: of the diverse selection.
        neighbours: probability that a new particle is proposed by a neighbour.
        lm_steps: Levenberg-Marquardt steps a new particle.
        lm_points: surface points a part that they use.
    """

    stitch: float = 4.0
    mismatch: float = 0.3
    temperature: float = 0.1
    neighbours: float = 0.5
    lm_steps: int = 4
    lm_points: int = 60


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """Result of a search.

    Attributes:
        state: the best body.
        cost: of Eq. 50 with the weights of the last stage.
        judged: the last particles of every part.
    """

    state: BodyState
    cost: float
    scored: list[ScoredParticles]


@dataclass(frozen=True, slots=True, eq=False)
class _SearchContext:
    """What all iterations of one search share: the cloud of every part, believed joints, and threads."""

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
        own: Mapping[int, CloudGrid] = NO_GRIDS,
        keep: int | None = None,
        threads: int = 1,
    ) -> SearchResult:
        """Improve particles and return the best body.

        Args:
            start: per part the first particles; a part with a single one stays as it is.
            grid: the cloud.
            targets: believed joints.
            stages: schedule; the last one ends at 1.
            iterations: rounds of proposing and selecting.
            rng: source of all randomness.
            progress: called with the fraction done.
            own: clouds of the parts that do not see `grid`.
            keep: particles a part that go on after all of the start were improved; None for as many as there are.
            threads: how many; the result does not depend on it.
        """
        turn = _SearchContext([own.get(part, grid) for part in range(len(start))], targets, threads)
        judged = [
            ScoredParticles.judge(points, particles, grid, targets)
            for points, particles, grid in zip(self._points, start, turn.grids, strict=True)
        ]
        searched = [part for part, particles in enumerate(start) if len(particles) > 1]
        counts = [len(particles) if keep is None else min(keep, len(particles)) for particles in start]
        if keep is not None:
            judged = self._improve_and_select(judged, {part: start[part] for part in searched}, counts, stages[0], turn)
        best = self._solve(judged, stages[0])[0].assignment
        for iteration in range(iterations):
            stage = next(stage for stage in stages if iteration < stage.until * iterations or stage is stages[-1])
            proposed = {part: self._propose(part, judged, best, stage, rng) for part in searched}
            judged = self._improve_and_select(judged, proposed, counts, stage, turn)
            best = np.zeros(len(judged), dtype=np.int64)
            if progress is not None:
                progress((iteration + 1) / iterations)
        result, _ = self._solve(judged, stages[-1])
        return SearchResult(self._body(judged, result), result.cost, judged)

    def modes(self, found: SearchResult, part: int) -> list[BodyState]:
        """The best body with each of the particles that a search left of a part."""
        nodes, edges = self._costs(found.scored, four_stages(self._model.tree)[-1])
        bodies = []
        for particle in range(len(nodes[part])):
            only = np.full(len(nodes[part]), EXCLUDED)
            only[particle] = nodes[part][particle]
            costs = [*nodes[:part], only, *nodes[part + 1 :]]
            bodies.append(self._body(found.scored, max_product(self._model.tree, costs, edges)))
        return bodies

    def _body(self, judged: list[ScoredParticles], result: MaxProduct) -> BodyState:
        return particles_to_state(self._model, [group.particles for group in judged], result.assignment)

    def _improve_and_select(
        self,
        judged: list[ScoredParticles],
        proposed: dict[int, Particles],
        counts: list[int],
        stage: Stage,
        turn: _SearchContext,
    ) -> list[ScoredParticles]:
        """Improve proposed particles, add them to the present ones, and keep `counts` of each part, the best first."""
        improved = parallel_map(
            lambda pair: self._improved(*pair, turn.grids[pair[0]], turn.targets), proposed.items(), turn.threads
        )
        judged = list(judged)
        for part, new in zip(proposed, improved, strict=True):
            judged[part] = judged[part].extend(new)
        result, edges = self._solve(judged, stage)
        for part in proposed:
            judged[part] = judged[part].take(self._select(part, counts[part], result, edges, stage.greedy))
        return judged

    def energy(self, state: BodyState, cloud: DataCost) -> float:
        """Eq. 50 of one body, with every weight as in the last stage of the search."""
        none = JointTargets.none(self._model)
        judged = [
            ScoredParticles.judge(points, group, cloud, none)
            for points, group in zip(self._points, states_to_particles(self._model, [state]), strict=True)
        ]
        return self._solve(judged, four_stages(self._model.tree)[-1])[0].cost

    def _propose(
        self, part: int, judged: list[ScoredParticles], best: np.ndarray, stage: Stage, rng: np.random.Generator
    ) -> Particles:
        if stage.greedy:
            copies = judged[part].particles.take(np.full(len(judged[part].particles), best[part]))
            return self._proposer.random_walk(copies, stage.noise, rng, deformation_only=0.5)
        return self._proposer.propose(part, judged, stage.noise, self._weights.neighbours, rng)

    def _improved(self, part: int, new: Particles, grid: CloudGrid, targets: JointTargets) -> ScoredParticles:
        moved = levenberg_marquardt(
            self._points[part], new, grid, targets, self._weights.lm_steps, self._weights.lm_points
        )
        return ScoredParticles.judge(self._points[part], moved, grid, targets)

    def _solve(self, judged: list[ScoredParticles], stage: Stage) -> tuple[MaxProduct, list[np.ndarray]]:
        """Run max-product with the weights of a stage."""
        nodes, edges = self._costs(judged, stage)
        return max_product(self._model.tree, nodes, edges), edges

    def _costs(self, judged: list[ScoredParticles], stage: Stage) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Costs of every part's particles and of every edge's pairs with the weights of a stage (Eqs. 50-52)."""
        nodes = [
            beta * (group.distance + self._weights.mismatch * group.mismatch) + group.pull
            for beta, group in zip(stage.data, judged, strict=True)
        ]
        edges = []
        for edge, (parent, child) in enumerate(self._model.tree.edges):
            a, b = judged[parent], judged[child]
            centers = a.particles.center, b.particles.center
            weight = self._model.interfaces[edge].weight
            cost = stitching_costs(weight, a.interfaces[edge], b.interfaces[edge], centers, self._weights.stitch)
            edges.append(stage.stitch[edge] * cost)
        return nodes, edges

    def _select(self, part: int, count: int, result: MaxProduct, edges: list[np.ndarray], greedy: bool) -> np.ndarray:
        """Choose the particles to keep, the one of the best body first."""
        kept = int(result.assignment[part])
        if greedy:
            order = np.argsort(result.marginals[part], kind="stable")
            return np.concatenate([[kept], order[order != kept][: count - 1]])
        foundation = message_foundation(self._model.tree, edges, result, part)
        return select_diverse(foundation, count, kept, self._weights.temperature)
