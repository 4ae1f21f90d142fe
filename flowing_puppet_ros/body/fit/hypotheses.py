# SPDX-License-Identifier: Apache-2.0
"""Finding a body of unknown pose: a search, and hypotheses of what it may have got wrong.

The energy hardly tells a body from the same one turned around, and a limb in the air or on another limb costs little.
The distance both ways, body to cloud and cloud to body, tells: every hypothesis is fitted and the closest body kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.cloud.correspondence import Cloud, two_way_distance
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.fit.initialisation import flip_heading, sample_bodies
from flowing_puppet_ros.body.fit.pose_bank import CoarseCloud, PoseBank
from flowing_puppet_ros.body.fit.quality import RELIABLY_UNCOVERED, FitQuality, assess_fit
from flowing_puppet_ros.body.fit.single_view_search import SingleViewSearch
from flowing_puppet_ros.body.refine.gauss_newton import GaussNewton, RefineWeights
from flowing_puppet_ros.body.search.dpmp import BodyParticleSearch, SearchWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.body.search.limb_search import SINGLE_LIMBS, LimbSearch, limb_groups
from flowing_puppet_ros.body.search.part_points import part_points
from flowing_puppet_ros.body.search.particles import Particles, states_to_particles
from flowing_puppet_ros.body.search.proposals import Proposer, WalkNoise
from flowing_puppet_ros.body.search.schedule import four_stages, local_stages
from flowing_puppet_ros.evidence.cloud.data_term import CloudGrid
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.parallel import parallel_map, usable_threads
from flowing_puppet_ros.settings import Settings, setting

Progress = Callable[[float], None]
# Steps of the finish of a hypothesis, and how many limbs that were searched anew are finished in a round.
HYPOTHESIS_STEPS, LIMBS_FINISHED = 12, 3
# Confidence of a part below which its limb may hang hidden.
LIMB_OFF = 0.6
# A limb hypothesis must be this much closer than the body that it came from, and none helps a body so many metres off.
CLOSER, HOPELESS = 0.98, 0.06
# Shares of the usual particles and of the usual rounds in a quick search, and in one that only loads what it uses.
QUICK, WARM = 0.5, 0.1
# Where this share of the cloud is uncovered the whole body is probably wrong: only a leap is worth another round.
MOSTLY_OFF, LEAP = 0.25, 0.9


@dataclass(frozen=True, slots=True)
class FitterSettings(Settings):
    """Settings of `BodyFitter`; the defaults are the fast ones, the thesis's are 80 particles and 120 iterations."""

    particles: int = setting(40, "particles a part", low=4, high=1000)
    iterations: int = setting(50, "rounds of the search when nothing is known of the pose", low=1, high=10000)
    local_particles: int = setting(20, "particles a part when the pose is roughly known", low=4, high=1000)
    local_iterations: int = setting(16, "rounds of the search when the pose is roughly known", low=0, high=10000)
    lm_steps: int = setting(4, "Levenberg-Marquardt steps a new particle", low=0, high=50)
    refine_iterations: int = setting(15, "Gauss-Newton steps of the finish", low=0, high=200)
    cloud_points: int = setting(10000, "points that a cloud is thinned to", low=200, high=200000)
    joint_strength: float = setting(0.02, "pull of an initial joint against the whole cloud's", low=0.0, high=100.0)
    clip_factor: float = setting(2.0, "limb radii around the initial joints' axes that a cloud is clipped to, 0: none",
                                 low=0.0, high=20.0)  # fmt: skip
    restarts: int = setting(1, "searches from new starts while no body comes close to the cloud", low=0, high=20)
    restart_distance: float = setting(0.02, "two-way distance at which a body is close", unit="m", low=0.0, high=1.0)
    limb_rounds: int = setting(3, "rounds in which limbs that seem misplaced are searched anew", low=0, high=20)
    surface_finish: bool = setting(True, "let the surface leave the model's where a whole cloud is dense")
    threads: int = setting(2, "threads, at most the cores there are; the result does not depend on it",
                           low=1, high=64)  # fmt: skip
    seed: int = setting(0, "seed of all that is random", low=0)


@dataclass(frozen=True, slots=True, eq=False)
class BodyCandidate:
    """A body and what the cloud says of it."""

    state: BodyState
    quality: FitQuality

    @property
    def cost(self) -> float:
        """What candidates are compared by, metres."""
        return self.quality.cost


class BodyHypotheses:
    """The search, its hypotheses and the finish, for one model."""

    def __init__(self, model: StitchedPuppet, settings: FitterSettings) -> None:
        self._model = model
        self._settings = settings
        self._threads = usable_threads(settings.threads)
        points = part_points(model)
        self.particle_search = BodyParticleSearch(model, points, SearchWeights(lm_steps=settings.lm_steps))
        self.refiner = GaussNewton(model)
        self._proposer = Proposer(model, points)
        self.limbs = LimbSearch(model, self.particle_search, self._proposer)
        self.bank = PoseBank(model, points)
        self._view_search = SingleViewSearch(model, self.bank, self._proposer, self.refiner, self._threads)

    def search(self, cloud: Cloud, rng: np.random.Generator, progress: Progress, quick: bool = False) -> BodyState:
        """The body of a cloud of which nothing but the upright is known.

        `quick` tries a small search first and is content when its body lies close, whatever its limbs do.
        """
        if isinstance(cloud, SingleViewCloud):
            return self._view_search.run(cloud, rng, self._settings.refine_iterations, progress)
        grid = CloudGrid.build(cloud.points, cloud.normals)
        none, steps = JointTargets.none(self._model), self._settings.refine_iterations
        if quick:
            best = self._both_headings(cloud, grid, rng, sub_progress(progress, 0.0, 0.3), QUICK)[0]
            if self._is_close(best):
                return self.refine(best.state, cloud, none, steps)
        tries = 1 + self._settings.restarts
        tried: list[BodyCandidate] = []
        for turn in range(tries):
            for candidate in self._both_headings(
                cloud, grid, rng, sub_progress(progress, turn / tries, (turn + 0.7) / tries)
            ):
                tried.append(self.repair_limbs(candidate, cloud, grid, rng))
                best = min(tried, key=lambda candidate: candidate.cost)
                if self._is_close(best):
                    return self.refine(best.state, cloud, none, steps)
        return self.refine(best.state, cloud, none, steps)

    def _is_close(self, candidate: BodyCandidate) -> bool:
        return candidate.cost < self._settings.restart_distance

    def warm_up(self, cloud: Cloud, view: SingleViewCloud) -> None:
        """Use all compiled code once, on any cloud from all sides and any from one side."""
        grid = CloudGrid.build(cloud.points, cloud.normals)
        self._both_headings(cloud, grid, np.random.default_rng(0), lambda _: None, WARM)
        state = self.bank.best(CoarseCloud.of(view), 1)[0]
        self.refine(state, view, JointTargets.none(self._model), 1)

    def search_near(
        self, body: BodyState, grid: CloudGrid, targets: JointTargets, rng: np.random.Generator, progress: Progress
    ) -> BodyState:
        """Search around a body; the body itself is among the first particles."""
        start = []
        for group in states_to_particles(self._model, [body]):
            copies = group.take(np.zeros(self._settings.local_particles - 1, dtype=np.int64))
            walked = self._proposer.random_walk(copies, WalkNoise(0.02, 0.12, 0.5, 0.2), rng)
            start.append(Particles.join([group, walked]))
        stages, iterations = local_stages(self._model.tree), self._settings.local_iterations
        return self.particle_search.optimise(
            start, grid, targets, stages, iterations, rng, progress, threads=self._threads
        ).state

    def refine(self, body: BodyState, cloud: Cloud, targets: JointTargets, steps: int) -> BodyState:
        """The body after `steps` of the Gauss-Newton over all parts."""
        terms = [cloud.free_space] if isinstance(cloud, SingleViewCloud) else []
        return self.refiner.run(body, cloud, targets, RefineWeights(iterations=steps), terms)

    def candidate(self, body: BodyState, cloud: Cloud) -> BodyCandidate:
        """A hypothesis after a short finish, judged."""
        steps = min(HYPOTHESIS_STEPS, self._settings.refine_iterations)
        state = self.refine(body, cloud, JointTargets.none(self._model), steps)
        return BodyCandidate(state, assess_fit(self._model, self._model.vertices(state), cloud))

    def _both_headings(
        self, cloud: Cloud, grid: CloudGrid, rng: np.random.Generator, progress: Progress, share: float = 1.0
    ) -> list[BodyCandidate]:
        """Search with unknown yaw: the body found and the best one that faces the other way, the closer one first.

        `share` is of the usual particles and rounds.
        """
        none = JointTargets.none(self._model)
        particles, iterations = (
            max(1, round(share * count)) for count in (self._settings.particles, self._settings.iterations)
        )
        bodies = sample_bodies(self._model, cloud.points.mean(axis=0), particles, rng)
        noise = WalkNoise(center=0.05, rotation=0.1, pose=0.0, shape=0.0)
        start = [self._proposer.random_walk(group, noise, rng) for group in states_to_particles(self._model, bodies)]
        stages = four_stages(self._model.tree)
        found = self.particle_search.optimise(
            start, grid, none, stages, iterations, rng, sub_progress(progress, 0.0, 0.8), threads=self._threads
        )
        body = self.candidate(found.state, cloud)
        turned = self.search_near(
            flip_heading(self._model, body.state), grid, none, rng, sub_progress(progress, 0.8, 1.0)
        )
        return sorted([body, self.candidate(turned, cloud)], key=lambda candidate: candidate.cost)

    def repair_limbs(
        self, body: BodyCandidate, cloud: Cloud, grid: CloudGrid, rng: np.random.Generator
    ) -> BodyCandidate:
        """The body with limbs moved to where they lie closer, while one seems to be in a wrong place."""
        for _ in range(self._settings.limb_rounds):
            if not body.quality.limb_suspect or body.cost > HOPELESS:
                break
            states = [body.state, *self._limbs_moved(body, cloud, grid, rng)]
            candidates = parallel_map(lambda state: self.candidate(state, cloud), states, self._threads)
            closest = min(candidates, key=lambda candidate: candidate.cost)
            wanted = LEAP if body.quality.uncovered > MOSTLY_OFF else CLOSER
            body, before = min(body, closest, key=lambda candidate: candidate.cost), body
            if closest.cost > wanted * before.cost:
                break
        return body

    def _limbs_moved(
        self, body: BodyCandidate, cloud: Cloud, grid: CloudGrid, rng: np.random.Generator
    ) -> list[BodyState]:
        """The closest of the bodies with limbs searched anew, and those with a limb that is off as it usually hangs.

        Several limbs at once are searched when much of the cloud is uncovered.
        """
        groups = limb_groups(self._model.tree)
        limbs = groups[:SINGLE_LIMBS]
        if body.quality.uncovered <= RELIABLY_UNCOVERED:
            groups = limbs
        found = parallel_map(
            lambda pair: self.limbs.run(body.state, pair[0], cloud, grid, pair[1]),
            list(zip(groups, rng.spawn(len(groups)), strict=True)),
            self._threads,
        )
        bodies = [state for state in found if state is not None]
        bodies.sort(key=lambda state: two_way_distance(self._model.vertices(state), self._model.faces, cloud))
        off = [limb for limb in limbs if body.quality.part_confidence[list(limb)].min() < LIMB_OFF]
        return bodies[:LIMBS_FINISHED] + [self.limbs.mean_limb(body.state, limb) for limb in off]


def sub_progress(progress: Progress, low: float, high: float) -> Progress:
    """Progress of one stretch of the work."""
    return lambda done: progress(low + (high - low) * done)
