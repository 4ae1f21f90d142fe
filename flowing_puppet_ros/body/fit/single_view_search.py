# SPDX-License-Identifier: Apache-2.0
"""The search for a body in a single view: whole bodies from a bank of poses, with limbs sampled again.

The thesis's data term asks every part by itself whether it lies on the cloud. A single view answers that badly: the far
half of every part must not lie on it, and parts behind others have no cloud at all. Here hypotheses are scored as whole
bodies by three questions. Is all of the cloud covered? Is anything in space that the sensor saw to be free? Are the
joints in likely poses? Only the last one places what the sensor did not see.

Most time goes into bodies that lose. So every round asks fewer of them, and the first steps match only a quarter of the
points each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.fit.partial_view import measure_unknown_share, strengthen_priors
from flowing_puppet_ros.body.fit.pose_bank import CoarseCloud, PoseBank
from flowing_puppet_ros.body.refine.gauss_newton import GaussNewton, RefineWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.body.search.particles import Particles, particles_to_state, states_to_particles
from flowing_puppet_ros.body.search.proposals import Proposer
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.process.threads import parallel_map

STARTS, KEPT_STARTS = 16, 12  # bodies of the bank that are refined, and those of them that are refined further
KEPT, SPARSE_KEPT = (6, 4, 3), (8, 6, 4)  # bodies whose limbs are sampled again in each round, and of sparse clouds
FINISHED = 3  # bodies that are finished
LIMB_SAMPLES = 300  # poses sampled for each stage of a limb
# Parts of an arm and of a leg from the trunk outwards, without the side; those of a stage are sampled at once.
LIMB_CHAINS = (
    (("shoulder", "upper_arm"), ("lower_arm",), ("hand",)),
    (("upper_leg",), ("lower_leg",), ("foot",)),
)
KEPT_SAMPLES = 40  # of them, for the next part of the limb, and in the end to be combined with another limb's
MIN_DIFFERENCE_M = 0.03  # mean distance between the centres of two bodies' parts, below which only the better is kept
type Limb = tuple[tuple[int, ...], ...]
"""The parts of a limb by stages, from the trunk outwards."""
MAX_COST_INCREASE_M = 0.003
"""Cost by which a sampled limb may exceed the present one and still be refined."""
MAX_EQUAL_COST_M = 0.0015
"""Cost by which another body may exceed the best one and still be as likely."""
MIN_DENSE_POINTS = 2000
"""Points below which a cloud is a LiDAR's: a few hundred points with centimetres of noise."""
# Two refinements of the bank's bodies, and that of a sampled limb.
FIRST = RefineWeights(sigma_start=0.2, sigma_end=0.13, iterations=4, alternate=4)
SECOND = RefineWeights(sigma_start=0.12, sigma_end=0.08, iterations=4, alternate=4)
CLOSE = RefineWeights(sigma_start=0.06, sigma_end=0.04, iterations=5, alternate=2)


@dataclass(frozen=True, slots=True, eq=False)
class _Sampled:
    """Sampled bodies: distances (P, M) m of the targets, and what the bodies cost beside their mean (P,), metres."""

    distance: np.ndarray
    other: np.ndarray

    @property
    def cost(self) -> np.ndarray:
        """Cost of the bodies (P,), metres."""
        return np.asarray(self.distance.mean(axis=1) + self.other)


class SingleViewSearch:
    """The search for bodies of one model in single views."""

    def __init__(
        self, model: StitchedPuppet, bank: PoseBank, proposer: Proposer, refiner: GaussNewton, threads: int = 1
    ) -> None:
        self._model = model
        self._threads = threads
        self._bank = bank
        self._proposer = proposer
        self._refiner = refiner
        self._limbs: list[Limb] = [
            tuple(tuple(model.tree.index(f"{side}_{name}") for name in stage) for stage in chain)
            for chain in LIMB_CHAINS
            for side in ("left", "right")
        ]

    def run(
        self, cloud: SingleViewCloud, rng: np.random.Generator, steps: int, progress: Callable[[float], None]
    ) -> list[BodyState]:
        """Find the body of a cloud in metres, z up, when only its up direction is known.

        Args:
            cloud: the cloud.
            rng: source of all randomness.
            steps: Gauss-Newton steps of the last refinement.
            progress: called with the fraction done, 0 to 1.

        Returns:
            The best body, and then others that explain the cloud nearly as well.
        """
        coarse = CoarseCloud.of(cloud)
        rounds = KEPT if _is_dense(cloud) else SPARSE_KEPT
        bodies = self._find_starts(cloud, coarse, rounds[0])
        progress(0.3)
        for number, (kept, improve) in enumerate(
            zip(rounds, (self._replace_limbs, self._improve_pairs, self._improve_limbs), strict=True)
        ):
            starts = list(zip(bodies[:kept], rng.spawn(kept), strict=False))
            improved = parallel_map(partial(_apply, improve, cloud, coarse), starts, self._threads)
            bodies = self._rank(improved, coarse)
            progress(0.3 + 0.5 * (number + 1) / len(rounds))
        weights = _final_weights(cloud, steps)
        bodies = parallel_map(lambda body: self._refine(body, cloud, weights), bodies[:FINISHED], self._threads)
        progress(1.0)
        costs = np.array([self._bank.cost(body, coarse) for body in bodies])
        best, *others = np.argsort(costs, kind="stable")
        return [bodies[best], *(bodies[k] for k in others if costs[k] < costs[best] + MAX_EQUAL_COST_M)]

    def _find_starts(self, cloud: SingleViewCloud, coarse: CoarseCloud, count: int) -> list[BodyState]:
        """Return the `count` best bodies of the bank after a few steps of Gauss-Newton, the best first."""
        bodies = self._bank.find_best(coarse, STARTS)
        for weights, kept in ((FIRST, KEPT_STARTS), (SECOND, count)):
            refine = partial(self._refine, cloud=cloud, weights=weights)
            bodies = self._rank(parallel_map(refine, bodies, self._threads), coarse)[:kept]
        return bodies

    def _rank(self, bodies: list[BodyState], coarse: CoarseCloud) -> list[BodyState]:
        """Return the bodies, the best first, without those that are nearly the same as a better one."""
        ranked: list[BodyState] = []
        for body in sorted(bodies, key=lambda body: self._bank.cost(body, coarse)):
            if all(np.linalg.norm(body.center - other.center, axis=1).mean() > MIN_DIFFERENCE_M for other in ranked):
                ranked.append(body)
        return ranked

    def _replace_limbs(
        self, body: BodyState, cloud: SingleViewCloud, coarse: CoarseCloud, rng: np.random.Generator
    ) -> BodyState:
        """Sample every limb again, one after the other, and refine once; return that body if it is better."""
        replaced = body
        for limb in self._limbs:
            cost = self._bank.cost(replaced, coarse)
            replaced = self._resample_limbs(replaced, (limb,), coarse, cost, rng) or replaced
        if replaced is body:
            return body
        return min(body, self._refine(replaced, cloud, CLOSE), key=lambda each: self._bank.cost(each, coarse))

    def _improve_pairs(
        self, body: BodyState, cloud: SingleViewCloud, coarse: CoarseCloud, rng: np.random.Generator
    ) -> BodyState:
        """Improve both arms at once and both legs at once: where two limbs are exchanged, neither moves alone."""
        return self._improve(body, (self._limbs[:2], self._limbs[2:]), cloud, coarse, rng)

    def _improve_limbs(
        self, body: BodyState, cloud: SingleViewCloud, coarse: CoarseCloud, rng: np.random.Generator
    ) -> BodyState:
        """Improve limb after limb."""
        return self._improve(body, [(limb,) for limb in self._limbs], cloud, coarse, rng)

    def _improve(
        self,
        body: BodyState,
        groups: Sequence[Sequence[Limb]],
        cloud: SingleViewCloud,
        coarse: CoarseCloud,
        rng: np.random.Generator,
    ) -> BodyState:
        """Sample limbs again, those of each group at once, and keep what is better after Gauss-Newton."""
        cost = self._bank.cost(body, coarse)
        for limbs in groups:
            proposed = self._resample_limbs(body, limbs, coarse, cost + MAX_COST_INCREASE_M, rng)
            if proposed is None:
                continue
            proposed = self._refine(proposed, cloud, CLOSE)
            new_cost = self._bank.cost(proposed, coarse)
            if new_cost < cost:
                body, cost = proposed, new_cost
        return body

    def _resample_limbs(
        self, body: BodyState, limbs: Sequence[Limb], coarse: CoarseCloud, max_cost: float, rng: np.random.Generator
    ) -> BodyState | None:
        """Return the body with the best of many samples of some limbs, None when all cost more than `max_cost`.

        Of several limbs the best samples of each are combined.
        """
        groups = states_to_particles(self._model, [body])
        moved = [[part for stage in limb for part in stage] for limb in limbs]
        rest = [part for part in range(len(groups)) if not any(part in parts for parts in moved)]
        without = self._bank.coverage_cost(groups, coarse, rest)
        base = _Sampled(without.distance, without.cost - without.distance.mean())
        total, rows = base, np.zeros((1, 0), dtype=np.int64)
        for limb in limbs:
            found = self._sample_limb(groups, limb, body, coarse, base, rng)
            total = _Sampled(
                np.minimum(total.distance[:, None], found.distance).reshape(-1, found.distance.shape[1]),
                np.add.outer(total.other, found.other - base.other).reshape(-1),
            )
            count = len(found.other)
            rows = np.column_stack([np.repeat(rows, count, axis=0), np.tile(np.arange(count), len(rows))])
        chosen = int(total.cost.argmin())
        if total.cost[chosen] > max_cost:
            return None
        pick = np.zeros(len(groups), dtype=np.int64)
        for parts, row in zip(moved, rows[chosen], strict=True):
            pick[parts] = row
        return particles_to_state(self._model, groups, pick)

    def _sample_limb(
        self,
        groups: list[Particles],
        limb: Limb,
        body: BodyState,
        coarse: CoarseCloud,
        base: _Sampled,
        rng: np.random.Generator,
    ) -> _Sampled:
        """Sample a limb from the trunk outwards, in place, and keep the best each time; `base` is the body without it.

        Half of the rotations are likely ones, the others are anywhere within the joints' limits.
        """
        kept, sampled = base, list[int]()
        for stage in limb:
            rows = np.arange(LIMB_SAMPLES) % len(kept.other)
            for part in sampled:
                groups[part] = groups[part].take(rows)
            for part in stage:
                parent = groups[self._model.tree.parents[part]]
                groups[part] = self._attach(part, parent.take(rows) if len(parent) == 1 else parent, body, rng)
            scored = self._bank.coverage_cost(groups, coarse, stage, kept.distance[rows])
            every = _Sampled(scored.distance, kept.other[rows] + scored.cost - scored.distance.mean(axis=1))
            best = np.argsort(every.cost, kind="stable")[:KEPT_SAMPLES]
            kept = _Sampled(every.distance[best], every.other[best])
            sampled += stage
            for part in sampled:
                groups[part] = groups[part].take(best)
        return kept

    def _attach(self, part: int, parent: Particles, body: BodyState, rng: np.random.Generator) -> Particles:
        """Attach a part to each particle of its parent, half of them in likely ways, the others anyhow."""
        likely, free = np.split(np.arange(len(parent)), 2)
        proposer, shape = self._proposer, body.shape[part]
        return Particles.join(
            [
                proposer.attach_likely(part, parent.take(likely), shape, rng),
                proposer.attach_to_parent(part, parent.take(free), shape, rng),
            ]
        )

    def _refine(self, body: BodyState, cloud: SingleViewCloud, weights: RefineWeights) -> BodyState:
        none = JointTargets.none(self._model)
        if cloud.field is not None:
            weights = strengthen_priors(weights, measure_unknown_share(self._model, body, cloud))
        return self._refiner.run(body, cloud, none, weights, terms=[cloud.free_space_term])


def _apply(
    improve: Callable[[BodyState, SingleViewCloud, CoarseCloud, np.random.Generator], BodyState],
    cloud: SingleViewCloud,
    coarse: CoarseCloud,
    start: tuple[BodyState, np.random.Generator],
) -> BodyState:
    """Improve a body with random numbers of its own."""
    return improve(start[0], cloud, coarse, start[1])


def _is_dense(cloud: SingleViewCloud) -> bool:
    """Return whether a cloud is dense and exact enough for a few bodies to settle the pose."""
    return len(cloud.points) >= MIN_DENSE_POINTS


def _final_weights(cloud: SingleViewCloud, steps: int) -> RefineWeights:
    """Return the weights of the last refinement; wider and with stronger priors against the noise of sparse clouds."""
    if _is_dense(cloud):
        return RefineWeights(sigma_start=0.08, iterations=steps)
    return RefineWeights(pose=1e-6, shape=5e-6, pairwise=1e-7, sigma_start=0.08, sigma_end=0.05, iterations=steps)
