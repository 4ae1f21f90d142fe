# SPDX-License-Identifier: Apache-2.0
"""The search for a body in a cloud from one side: bodies judged whole, from a bank of poses, and limbs hung anew.

The thesis's data term asks every part for itself whether it lies on the cloud. One side of a body answers that badly:
the far half of every part must not lie on it, and parts behind others have no cloud at all. Here hypotheses are judged
as whole bodies by three questions. Is all of the cloud covered? Does anything stand where the sensor looked through?
Are the joints turned as people turn them? The last alone places what nobody saw.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.fit.pose_bank import CoarseCloud, PoseBank
from flowing_puppet_ros.body.refine.gauss_newton import GaussNewton, RefineWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.body.search.particles import particles_to_state, states_to_particles
from flowing_puppet_ros.body.search.proposals import Proposer
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.parallel import parallel_map

STARTS, KEPT = 32, 8
LIMB_SAMPLES, LIMB_ROUNDS = 600, 3
CHAINS = (("shoulder", "upper_arm", "lower_arm", "hand"), ("upper_leg", "lower_leg", "foot"))
TRIED = 0.003
"""Metres by which a limb may look worse than the present one before Gauss-Newton and still be tried."""
SPARSE = 2000
"""Points below which a cloud is a LiDAR's: a few hundred points with centimetres of noise."""
ROUGH = RefineWeights(sigma_start=0.2, sigma_end=0.08, iterations=8)
CLOSE = RefineWeights(sigma_start=0.06, sigma_end=0.04, iterations=5)


class SingleViewSearch:
    """Finds bodies of one model in clouds from one side."""

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
            for chain in CHAINS
            for side in ("left", "right")
        ]

    def run(
        self, cloud: SingleViewCloud, rng: np.random.Generator, steps: int, progress: Callable[[float], None]
    ) -> BodyState:
        """Find the body of a cloud in metres, z up, of which nothing is known but that it is upright.

        Args:
            cloud: the cloud.
            rng: source of all randomness.
            steps: Gauss-Newton steps of the finish.
            progress: called with the fraction done.
        """
        coarse = CoarseCloud.of(cloud)
        starts = self._starts(cloud, coarse)
        progress(0.2)

        def improved(start: tuple[BodyState, np.random.Generator]) -> tuple[float, BodyState]:
            body = self._with_better_limbs(start[0], cloud, coarse, start[1])
            body = self._refined(body, cloud, _finish(cloud, steps))
            return self._bank.cost(body, coarse), body

        found = parallel_map(improved, list(zip(starts, rng.spawn(len(starts)), strict=True)), self._threads)
        progress(1.0)
        return min(found, key=lambda pair: pair[0])[1]

    def _starts(self, cloud: SingleViewCloud, coarse: CoarseCloud) -> list[BodyState]:
        """The best of the bank's bodies after a few steps of Gauss-Newton."""
        best = self._bank.best(coarse, STARTS)
        bodies = parallel_map(lambda body: self._refined(body, cloud, ROUGH), best, self._threads)
        return sorted(bodies, key=lambda body: self._bank.cost(body, coarse))[:KEPT]

    def _with_better_limbs(
        self, body: BodyState, cloud: SingleViewCloud, coarse: CoarseCloud, rng: np.random.Generator
    ) -> BodyState:
        """Hang every limb anew in many ways, keep what is better after Gauss-Newton, until nothing is."""
        cost = self._bank.cost(body, coarse)
        for _ in range(LIMB_ROUNDS):
            changed = False
            for limb in self._limbs:
                hung = self._resample_limb(body, limb, coarse, cost + TRIED, rng)
                if hung is None:
                    continue
                hung = self._refined(hung, cloud, CLOSE)
                new = self._bank.cost(hung, coarse)
                if new < cost:
                    body, cost, changed = hung, new, True
            if not changed:
                break
        return body

    def _resample_limb(
        self, body: BodyState, limb: tuple[int, ...], coarse: CoarseCloud, limit: float, rng: np.random.Generator
    ) -> BodyState | None:
        """The body with the best of many samples of one limb, None when all cost more than `limit`."""
        groups = states_to_particles(self._model, [body])
        rest = [part for part in range(len(groups)) if part not in limb]
        without = self._bank.coverage_cost(groups, coarse, rest)
        for part in limb:
            above = groups[self._model.tree.parents[part]]
            above = above if len(above) > 1 else above.take(np.zeros(LIMB_SAMPLES, dtype=np.int64))
            groups[part] = self._proposer.attach_to_parent(part, above, body.shape[part], rng)
        judged = self._bank.coverage_cost(groups, coarse, limb, without.distance)
        total = judged.cost + without.cost - without.distance.mean()
        best = int(total.argmin())
        if total[best] > limit:
            return None
        pick = np.zeros(len(groups), dtype=np.int64)
        pick[list(limb)] = best
        return particles_to_state(self._model, groups, pick)

    def _refined(self, body: BodyState, cloud: SingleViewCloud, weights: RefineWeights) -> BodyState:
        none = JointTargets.none(self._model)
        return self._refiner.run(body, cloud, none, weights, terms=[cloud.free_space])


def _finish(cloud: SingleViewCloud, steps: int) -> RefineWeights:
    """Noise of centimetres must not bend a body: sparse clouds take a wider kernel and heavier priors."""
    if len(cloud.points) >= SPARSE:
        return RefineWeights(sigma_start=0.08, iterations=steps)
    return RefineWeights(pose=1e-6, shape=5e-6, pairwise=1e-7, sigma_start=0.08, sigma_end=0.05, iterations=steps)
