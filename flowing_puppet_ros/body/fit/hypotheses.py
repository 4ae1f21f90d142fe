# SPDX-License-Identifier: Apache-2.0
"""Finds a body of unknown pose: a search, and hypotheses of what it may have got wrong.

The energy of a body and that of the same body facing the other way are nearly equal, and a limb in the air or on
another limb costs little. The two-way distance between body and cloud decides: every hypothesis is refined and the
closest body kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.cloud.correspondence import Cloud, two_way_distance
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.fit.initialisation import flip_heading, sample_bodies
from flowing_puppet_ros.body.fit.partial_view import measure_unknown_share, strengthen_priors
from flowing_puppet_ros.body.fit.pose_bank import CoarseCloud, PoseBank
from flowing_puppet_ros.body.fit.quality import MAX_UNCOVERED, FitQuality, assess_fit
from flowing_puppet_ros.body.fit.single_view_search import SingleViewSearch
from flowing_puppet_ros.body.refine.gauss_newton import GaussNewton, RefineWeights
from flowing_puppet_ros.body.search.body_energy import BodyEnergy
from flowing_puppet_ros.body.search.dpmp import BodyParticleSearch, SearchWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.body.search.limb_search import SINGLE_LIMBS, LimbSearch, limb_groups
from flowing_puppet_ros.body.search.part_points import build_part_points
from flowing_puppet_ros.body.search.particles import Particles, states_to_particles
from flowing_puppet_ros.body.search.proposals import Proposer, WalkNoise
from flowing_puppet_ros.body.search.schedule import four_stages, local_stages
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.evidence.cloud.data_term import CloudGrid
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.process.threads import parallel_map, usable_threads

Progress = Callable[[float], None]
# Gauss-Newton steps of a hypothesis.
MAX_HYPOTHESIS_STEPS = 12
# Limbs of a repair round that are refined, of those that were searched again.
MAX_REFINED_LIMBS = 3
# Confidence of a part below which its limb may be hidden.
MIN_LIMB_CONFIDENCE = 0.6
# Cost of a body from which on no limb hypothesis helps.
MAX_REPAIRABLE_COST_M = 0.06
# Cost of the best limb hypothesis, in costs of the body that it came from, for another repair round; the second where
# so much of the cloud is uncovered that the whole body is probably wrong.
MAX_COST_RATIO, MAX_COST_RATIO_IF_WRONG, MIN_WRONG_UNCOVERED = 0.98, 0.9, 0.25
# Gauss-Newton from initial joints where the sensor sees a part of the person only.
PARTIAL = RefineWeights(sigma_start=0.2, sigma_end=0.03, iterations=20)
# Bodies that are refined to compare frames, and their Gauss-Newton steps.
ROUGH_STARTS = 4
ROUGH = RefineWeights(sigma_start=0.2, sigma_end=0.08, iterations=8, alternate=2)
# Share of the particles and rounds in a search for the warm-up.
RESTART_SHARE = 2.0  # of particles and iterations, in a search after the first
WARM_UP_SHARE = 0.1
# Cost up to which a body is not wrong as a whole: without its feet, one that faces backwards may cost twice as much.
SURE_COST_M = 0.01
# Cost of a body turned to the other heading, in costs of the body itself, from which on no search around it helps.
MAX_TURNED_RATIO = 1.3


@dataclass(frozen=True, slots=True, eq=False)
class BodyCandidate:
    """A body with its quality on the cloud."""

    state: BodyState
    quality: FitQuality

    @property
    def cost(self) -> float:
        """Cost by which candidates are compared, metres."""
        return self.quality.cost


class BodyHypotheses:
    """The search, its hypotheses and their refinement, for one model."""

    def __init__(self, model: StitchedPuppet, settings: FitterSettings) -> None:
        self._model = model
        self._settings = settings
        self._threads = usable_threads(settings.threads)
        points = build_part_points(model)
        weights = SearchWeights(lm_steps=settings.levenberg_steps)
        self.particle_search = BodyParticleSearch(model, points, weights)
        self.energy = BodyEnergy(model, points, weights.stitch, weights.mismatch)
        self.gauss_newton = GaussNewton(model)
        self.proposer = Proposer(model, points)
        self.limb_search = LimbSearch(model, self.particle_search, self.proposer)
        self.pose_bank = PoseBank(model, points)
        self._single_view_search = SingleViewSearch(
            model, self.pose_bank, self.proposer, self.gauss_newton, self._threads
        )

    def search(
        self, cloud: Cloud, rng: np.random.Generator, progress: Progress, quick: bool = False
    ) -> list[BodyState]:
        """Find the body of a cloud in metres, z up, when only its up direction is known.

        In a single view, bodies that explain it nearly as well follow the best one.

        Cases:
            single view: the search from the pose bank, by itself; what follows is for whole clouds.
            quick: enough if the first search is close, whatever its limbs do.
            restarts: 1 + `restarts` searches, each in both headings, until a body is close and reliable; a restart has
                more particles and iterations, since a small search has failed.
            repair: suspect limbs of each candidate are searched again before it is compared.
        """
        if isinstance(cloud, SingleViewCloud):
            found = self._single_view_search.run(cloud, rng, self._settings.gauss_newton_steps, progress)
            return found if len(found) == 1 else sorted(found, key=lambda body: self._measure_uncovered(body, cloud))
        grid = CloudGrid.build(cloud.points, cloud.normals)
        none, steps = JointTargets.none(self._model), self._settings.gauss_newton_steps
        tries = 1 + self._settings.restarts
        tried: list[BodyCandidate] = []
        for number in range(tries):
            shown = sub_progress(progress, number / tries, (number + 0.7) / tries)
            candidates = self._search_both_headings(cloud, grid, rng, shown, RESTART_SHARE if number else 1.0)
            if quick and self._is_close(candidates[0]):
                return [self.refine(candidates[0].state, cloud, none, steps)]
            turned_is_near = candidates[1].cost < MAX_TURNED_RATIO * candidates[0].cost
            for candidate in candidates:
                tried.append(self.repair_limbs(candidate, cloud, grid, rng))
                best = min(tried, key=lambda candidate: candidate.cost)
                contested = candidate is candidates[0] and best.cost > SURE_COST_M and turned_is_near
                if self._is_close(best) and best.quality.reliable and not contested:
                    return [self.refine(best.state, cloud, none, steps)]
        return [self.refine(best.state, cloud, none, steps)]

    def _measure_uncovered(self, body: BodyState, cloud: Cloud) -> float:
        """Return the share of a cloud that a body leaves uncovered: of bodies that are as likely, it tells best."""
        return assess_fit(self._model, self._model.vertices(body), cloud).uncovered

    def find_close(self, cloud: Cloud) -> BodyState | None:
        """Return a body that few poses and steps bring close to a cloud, whatever its limbs do; None without any."""
        found = self.evaluate(self.find_roughly(cloud, thorough=False).state, cloud)
        return found.state if self._is_close(found) else None

    def _is_close(self, candidate: BodyCandidate) -> bool:
        return candidate.cost < self._settings.restart_distance

    def warm_up(self, cloud: Cloud, view: SingleViewCloud) -> None:
        """Run all compiled code once, on a whole cloud and on a single view."""
        grid = CloudGrid.build(cloud.points, cloud.normals)
        body = self._search_unknown(cloud, grid, np.random.default_rng(0), lambda _: None, WARM_UP_SHARE)
        self.evaluate(flip_heading(self._model, body), cloud)
        state = self.pose_bank.find_best(CoarseCloud.of(view), 1)[0]
        self.refine(state, view, JointTargets.none(self._model), 1)

    def find_roughly(self, cloud: Cloud, thorough: bool) -> BodyCandidate:
        """Return the closest of a few bodies of the pose bank, of all of it if `thorough`, after some Gauss-Newton."""
        terms = [cloud.free_space_term] if isinstance(cloud, SingleViewCloud) else []
        none = JointTargets.none(self._model)

        def improve(body: BodyState) -> BodyCandidate:
            state = self.gauss_newton.run(body, cloud, none, ROUGH, terms)
            return BodyCandidate(state, assess_fit(self._model, self._model.vertices(state), cloud))

        bank = self.pose_bank
        starts = (
            bank.find_best(CoarseCloud.of(cloud), ROUGH_STARTS) if thorough else bank.find_roughly(cloud, ROUGH_STARTS)
        )
        found = parallel_map(improve, starts, self._threads)
        return min(found, key=lambda candidate: candidate.cost)

    def search_near(
        self, body: BodyState, grid: CloudGrid, targets: JointTargets, rng: np.random.Generator, progress: Progress
    ) -> BodyState:
        """Search around a body; the body itself is among the first particles."""
        start = []
        for group in states_to_particles(self._model, [body]):
            copies = group.take(np.zeros(self._settings.local_particles - 1, dtype=np.int64))
            walked = self.proposer.random_walk(copies, WalkNoise(0.02, 0.12, 0.5, 0.2), rng)
            start.append(Particles.join([group, walked]))
        stages, iterations = local_stages(self._model.tree), self._settings.local_iterations
        return self.particle_search.optimise(
            start, grid, targets, stages, iterations, rng, progress, threads=self._threads
        ).state

    def refine(self, body: BodyState, cloud: Cloud, targets: JointTargets, steps: int, alternate: int = 1) -> BodyState:
        """Return the body after `steps` Gauss-Newton steps over all parts; `alternate` is that of `RefineWeights`."""
        terms = [cloud.free_space_term] if isinstance(cloud, SingleViewCloud) else []
        return self.gauss_newton.run(body, cloud, targets, RefineWeights(iterations=steps, alternate=alternate), terms)

    def refine_partial(self, body: BodyState, cloud: SingleViewCloud, targets: JointTargets) -> BodyState:
        """Return a body that lies roughly on the seen part of a person after Gauss-Newton steps over all parts."""
        weights = strengthen_priors(PARTIAL, measure_unknown_share(self._model, body, cloud))
        return self.gauss_newton.run(body, cloud, targets, weights, [cloud.free_space_term])

    def evaluate(self, body: BodyState, cloud: Cloud) -> BodyCandidate:
        """Refine a hypothesis briefly and assess it."""
        steps = min(MAX_HYPOTHESIS_STEPS, self._settings.gauss_newton_steps)
        state = self.refine(body, cloud, JointTargets.none(self._model), steps, alternate=2)
        return BodyCandidate(state, assess_fit(self._model, self._model.vertices(state), cloud))

    def _search_both_headings(
        self, cloud: Cloud, grid: CloudGrid, rng: np.random.Generator, progress: Progress, share: float = 1.0
    ) -> list[BodyCandidate]:
        """Search with unknown yaw; return that body and the best one with the opposite heading, the closer one first.

        `share` is the share of the settings' particles and iterations to use.
        """
        found = self._search_unknown(cloud, grid, rng, sub_progress(progress, 0.0, 0.8), share)
        body = self.evaluate(found, cloud)
        turned = flip_heading(self._model, body.state)
        flipped = self.evaluate(turned, cloud)
        if flipped.cost < MAX_TURNED_RATIO * body.cost:
            near = self.search_near(turned, grid, JointTargets.none(self._model), rng, sub_progress(progress, 0.8, 1.0))
            flipped = min(flipped, self.evaluate(near, cloud), key=lambda candidate: candidate.cost)
        return sorted([body, flipped], key=lambda candidate: candidate.cost)

    def _search_unknown(
        self, cloud: Cloud, grid: CloudGrid, rng: np.random.Generator, progress: Progress, share: float
    ) -> BodyState:
        """Search with unknown yaw; `share` is that of the settings' particles and iterations to use."""
        particles, iterations = (
            max(1, round(share * count)) for count in (self._settings.particles, self._settings.iterations)
        )
        bodies = sample_bodies(self._model, cloud.points.mean(axis=0), particles, rng)
        noise = WalkNoise(center=0.05, rotation=0.1, pose=0.0, shape=0.0)
        start = [self.proposer.random_walk(group, noise, rng) for group in states_to_particles(self._model, bodies)]
        stages = four_stages(self._model.tree)
        return self.particle_search.optimise(
            start, grid, JointTargets.none(self._model), stages, iterations, rng, progress, threads=self._threads
        ).state

    def repair_limbs(
        self, body: BodyCandidate, cloud: Cloud, grid: CloudGrid, rng: np.random.Generator
    ) -> BodyCandidate:
        """Search suspect limbs of a body again, round after round, while that brings it closer to the cloud.

        First one by one, then, where much of the cloud stays uncovered, also several at once.
        """
        several = False
        for _ in range(self._settings.max_limb_repairs):
            if not body.quality.limb_suspect or body.cost > MAX_REPAIRABLE_COST_M:
                break
            states = self._propose_limbs(body, cloud, grid, rng, several)
            candidates = parallel_map(lambda state: self.evaluate(state, cloud), states, self._threads)
            before, body = body, min([body, *candidates], key=lambda candidate: candidate.cost)
            wrong = before.quality.uncovered > MIN_WRONG_UNCOVERED
            helped = body.cost <= (MAX_COST_RATIO_IF_WRONG if wrong else MAX_COST_RATIO) * before.cost
            uncovered = body.quality.uncovered > MAX_UNCOVERED
            if not helped and (several or not uncovered):
                break
            several = uncovered
        return body

    def _propose_limbs(
        self, body: BodyCandidate, cloud: Cloud, grid: CloudGrid, rng: np.random.Generator, several: bool
    ) -> list[BodyState]:
        """Return the closest bodies with limbs searched again, and those with a doubtful limb at its mean pose.

        `several` limbs are also searched at once.
        """
        groups = limb_groups(self._model.tree)
        limbs = groups[:SINGLE_LIMBS]
        if not several:
            groups = limbs
        found = parallel_map(
            lambda pair: self.limb_search.run(body.state, pair[0], cloud, grid, pair[1]),
            list(zip(groups, rng.spawn(len(groups)), strict=True)),
            self._threads,
        )
        bodies = [state for state in found if state is not None]
        bodies.sort(key=lambda state: two_way_distance(self._model.vertices(state), self._model.faces, cloud))
        doubtful = [limb for limb in limbs if body.quality.part_confidence[list(limb)].min() < MIN_LIMB_CONFIDENCE]
        at_mean = [self.limb_search.pose_limb_at_mean(body.state, limb) for limb in doubtful]
        return bodies[:MAX_REFINED_LIMBS] + at_mean


def sub_progress(progress: Progress, low: float, high: float) -> Progress:
    """Return the progress of a part of the work, from `low` to `high` of the whole."""
    return lambda done: progress(low + (high - low) * done)
