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

from collections.abc import Callable
from functools import partial

import numpy as np

from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.fit.partial_view import measure_unknown_share, strengthen_priors
from flowing_puppet_ros.body.fit.pose_bank import CoarseCloud, PoseBank
from flowing_puppet_ros.body.refine.gauss_newton import GaussNewton, RefineWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.body.search.particles import particles_to_state, states_to_particles
from flowing_puppet_ros.body.search.proposals import Proposer
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.threads import parallel_map

STARTS, KEPT_STARTS = 16, 12  # bodies of the bank that are refined, and those of them that are refined further
KEPT, FINISHED = (8, 6, 4), 3  # bodies whose limbs are sampled again in each round, and those that are finished
LIMB_SAMPLES = 600  # poses sampled for each limb in a round
# Parts of an arm and of a leg from the trunk outwards, without the side.
LIMB_CHAINS = (("shoulder", "upper_arm", "lower_arm", "hand"), ("upper_leg", "lower_leg", "foot"))
MAX_COST_INCREASE_M = 0.003
"""Cost by which a sampled limb may exceed the present one and still be refined."""
MIN_DENSE_POINTS = 2000
"""Points below which a cloud is a LiDAR's: a few hundred points with centimetres of noise."""
# Two refinements of the bank's bodies, and that of a sampled limb.
FIRST = RefineWeights(sigma_start=0.2, sigma_end=0.13, iterations=4, alternate=4)
SECOND = RefineWeights(sigma_start=0.12, sigma_end=0.08, iterations=4, alternate=4)
CLOSE = RefineWeights(sigma_start=0.06, sigma_end=0.04, iterations=5, alternate=2)


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
        self._limbs = [
            tuple(model.tree.index(f"{side}_{name}") for name in chain)
            for chain in LIMB_CHAINS
            for side in ("left", "right")
        ]

    def run(
        self, cloud: SingleViewCloud, rng: np.random.Generator, steps: int, progress: Callable[[float], None]
    ) -> BodyState:
        """Find the body of a cloud in metres, z up, when only its up direction is known.

        Args:
            cloud: the cloud.
            rng: source of all randomness.
            steps: Gauss-Newton steps of the last refinement.
            progress: called with the fraction done, 0 to 1.
        """
        coarse = CoarseCloud.of(cloud)
        found = [(body, True) for body in self._find_starts(cloud, coarse)]
        progress(0.3)

        def improve(start: tuple[tuple[BodyState, bool], np.random.Generator]) -> tuple[BodyState, bool]:
            (body, changed), own = start
            return self._improve_limbs(body, cloud, coarse, own) if changed else (body, False)

        for number, kept in enumerate(KEPT):
            pairs = zip(found[:kept], rng.spawn(kept), strict=False)
            found = sorted(
                parallel_map(improve, list(pairs), self._threads), key=lambda pair: self._bank.cost(pair[0], coarse)
            )
            progress(0.3 + 0.5 * (number + 1) / len(KEPT))
        weights = _final_weights(cloud, steps)
        bodies = parallel_map(lambda pair: self._refine(pair[0], cloud, weights), found[:FINISHED], self._threads)
        progress(1.0)
        return min(bodies, key=lambda body: self._bank.cost(body, coarse))

    def _find_starts(self, cloud: SingleViewCloud, coarse: CoarseCloud) -> list[BodyState]:
        """Return the bank's best bodies after a few steps of Gauss-Newton, the best first."""
        bodies = self._bank.find_best(coarse, STARTS)
        for weights, kept in ((FIRST, KEPT_STARTS), (SECOND, KEPT[0])):
            refine = partial(self._refine, cloud=cloud, weights=weights)
            bodies = parallel_map(refine, bodies, self._threads)
            bodies = sorted(bodies, key=lambda body: self._bank.cost(body, coarse))[:kept]
        return bodies

    def _improve_limbs(
        self, body: BodyState, cloud: SingleViewCloud, coarse: CoarseCloud, rng: np.random.Generator
    ) -> tuple[BodyState, bool]:
        """Sample every limb again and keep what is better after Gauss-Newton; return also whether anything is."""
        cost, changed = self._bank.cost(body, coarse), False
        for limb in self._limbs:
            proposed = self._resample_limb(body, limb, coarse, cost + MAX_COST_INCREASE_M, rng)
            if proposed is None:
                continue
            proposed = self._refine(proposed, cloud, CLOSE)
            new_cost = self._bank.cost(proposed, coarse)
            if new_cost < cost:
                body, cost, changed = proposed, new_cost, True
        return body, changed

    def _resample_limb(
        self, body: BodyState, limb: tuple[int, ...], coarse: CoarseCloud, max_cost: float, rng: np.random.Generator
    ) -> BodyState | None:
        """Return the body with the best of many samples of one limb, None when all cost more than `max_cost`."""
        groups = states_to_particles(self._model, [body])
        rest = [part for part in range(len(groups)) if part not in limb]
        without = self._bank.coverage_cost(groups, coarse, rest)
        for part in limb:
            above = groups[self._model.tree.parents[part]]
            above = above if len(above) > 1 else above.take(np.zeros(LIMB_SAMPLES, dtype=np.int64))
            groups[part] = self._proposer.attach_to_parent(part, above, body.shape[part], rng)
        sampled = self._bank.coverage_cost(groups, coarse, limb, without.distance)
        total = sampled.cost + without.cost - without.distance.mean()
        best = int(total.argmin())
        if total[best] > max_cost:
            return None
        pick = np.zeros(len(groups), dtype=np.int64)
        pick[list(limb)] = best
        return particles_to_state(self._model, groups, pick)

    def _refine(self, body: BodyState, cloud: SingleViewCloud, weights: RefineWeights) -> BodyState:
        none = JointTargets.none(self._model)
        if cloud.field is not None:
            weights = strengthen_priors(weights, measure_unknown_share(self._model, body, cloud))
        return self._refiner.run(body, cloud, none, weights, terms=[cloud.free_space_term])


def _final_weights(cloud: SingleViewCloud, steps: int) -> RefineWeights:
    """Return the weights of the last refinement; wider and with stronger priors against the noise of sparse clouds."""
    if len(cloud.points) >= MIN_DENSE_POINTS:
        return RefineWeights(sigma_start=0.08, iterations=steps)
    return RefineWeights(pose=1e-6, shape=5e-6, pairwise=1e-7, sigma_start=0.08, sigma_end=0.05, iterations=steps)
