# SPDX-License-Identifier: Apache-2.0
"""The people in a scan of a scene: candidates, a cheap filter, an upright body for each that passes, and its proof."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.segmentation.candidates import Candidate, SceneHeights, find_candidates
from flowing_puppet_ros.body.segmentation.people import person_score
from flowing_puppet_ros.body.upright.candidate_shape import describe_candidates
from flowing_puppet_ros.body.upright.found_body import (
    SAME_PERSON_M,
    FirstFit,
    FitBudget,
    FoundBody,
    JudgedFit,
    ScanView,
    SearchedScan,
    find_only_reached,
    pop_nearest,
    take_apart,
)
from flowing_puppet_ros.body.upright.person_model import POSED, UPRIGHT, PersonModel
from flowing_puppet_ros.body.upright.posed_search import PosedSearch, see_candidate
from flowing_puppet_ros.body.upright.rejected_places import RejectedCandidate, RejectedPlaces
from flowing_puppet_ros.body.upright.scan_rays import ScanRays
from flowing_puppet_ros.body.upright.step import find_step
from flowing_puppet_ros.body.upright.upright_fit import MIN_MANY_POINTS, UprightFit, UprightFitter
from flowing_puppet_ros.body.upright.verification import weigh_fit
from flowing_puppet_ros.evidence.cloud.nearest import find_beside
from flowing_puppet_ros.process.threads import one_blas_thread, parallel_map, usable_threads
from flowing_puppet_ros.settings import Settings, setting

MIN_BENT_POINTS, MIN_BENT_PROBABILITY, MIN_BENT_SCORE = 1000, 0.4, 0.5
"""Points, probability by shape, and score of what a full search is made for though no upright body explains it."""
MIN_WORTHWHILE, MIN_SHAPELY = 0.15, 0.6
"""Probability by the bank's best body from which on its other bodies are refined too, and probability by shape from
which on they are whatever the best says: somebody who leans is often nearer to another one."""
MIN_TRACKED = 0.5
"""Probability of a tracked body below which a new one is tried where few points show the person."""
COME_ODDS, COME_FILTER = 1.5, 0.3
"""Log odds by which something that stands where the sensor once saw through is a person, and the share of the filter's
limit that is asked of it. Cars and doors move too."""
COLUMN_FILTER = 0.7  # the same of a column of a larger cluster: who stands close to others has a part of their shape
MIN_QUICK_BESIDE = 0.5  # probability of who is found beside a quick body
MIN_STEP = 0.6  # probability of who is found on a step only
BESIDE_M, CONTEXT_M, OWN_M = 1.0, 1.0, 0.10
"""Distance from a person within which others are looked for in what that person leaves, of their surroundings beyond,
and from a body, up to which points are its own."""

MAX_FLOOR_FITS, MAX_FLOOR_COST_M = 4, 0.1
"""Bodies by which a floor is rated, and the cost of a body that says nothing for it."""


@dataclass(frozen=True)
class PersonFinderSettings(Settings):
    """Settings of `PersonFinder`."""

    min_points: int = setting(25, "minimum number of points of a person", low=15, high=100000)
    min_probability: float = setting(0.3, "minimum probability of a body to be a person", low=0.0, high=1.0)
    min_filter: float = setting(
        0.3, "minimum probability, by its shape alone, of what is fitted", low=0.0, high=1.0, advanced=True
    )
    max_fits: int = setting(40, "maximum number of bodies fitted in a scan", low=1, high=1000, advanced=True)
    rejected_time: float = setting(
        10.0,
        "time for which what is no person is not fitted again at its place",
        unit="s",
        low=0.0,
        high=3600.0,
        advanced=True,
    )


class PersonFinder:
    """Finds the people in the scans of one sensor, and remembers what was none.

    Attributes:
        upright: fits the bodies.
        last_rejected: what was no person in the last scan.
        left_over: whether candidates of the last scan were left to the next one.
    """

    def __init__(self, fitter: BodyFitter, settings: PersonFinderSettings) -> None:
        """Fit with the model of `fitter`."""
        self._fitter = fitter
        self._settings = settings
        self.upright = UprightFitter(fitter)
        self._threads = usable_threads(fitter.settings.threads)
        self._rejected = RejectedPlaces(settings.rejected_time)
        self._posed = PosedSearch(self.upright, fitter.model, settings.min_filter, settings.rejected_time)
        self.last_rejected: list[RejectedCandidate] = []
        self.left_over = False
        self._view: ScanView | None = None
        self._is_stream = False
        self._owned = np.empty(0, dtype=bool)

    def warm_up(self) -> None:
        """Do beforehand what the first scan would wait for."""
        self.upright.warm_up()
        for name in (UPRIGHT, POSED):
            PersonModel.load(name)

    def reset(self) -> None:
        """Forget what was no person."""
        self._rejected.clear()
        self._posed.clear()
        self._view = None

    @one_blas_thread()
    def find(
        self, scan: SearchedScan, budget: FitBudget | None = None, remember: bool = True, only_known: bool = False
    ) -> list[FoundBody]:
        """Find the people in a scan; the same scans give the same answer.

        Args:
            scan: what is seen, and who is expected.
            budget: of fits, to the likeliest candidates first; None: as many as are set.
            remember: whether what is no person is remembered, and what was none is left out.
            only_known: nobody else is looked for, unless one of those who are expected is not there.
        """
        self.last_rejected = []
        self.left_over = False
        self._view, self._is_stream = None, remember
        scene, viewpoint, known, expected = scan.scene, scan.viewpoint, scan.known, scan.expected
        if scene is None or len(scene.points) < self._settings.min_points:
            return []
        points = scene.points
        middles = [np.asarray(body)[:, :2].mean(axis=0) if len(body) else np.full(2, np.inf) for body in known]
        if expected:
            known = [body if each.claims else body[:0] for body, each in zip(known, expected, strict=True)]
            only_known = only_known and all(each.claims for each in expected)
        candidates, owned = find_candidates(scene, viewpoint, self._settings.min_points, known, only_known, low=True)
        if only_known and len(owned) < sum(len(body) > 0 for body in known):
            candidates, owned = find_candidates(scene, viewpoint, self._settings.min_points, known, low=True)
        make = scan.make_person
        people = [
            FoundBody(make(rows, owner=owner), None)
            for owner, rows in owned.items()
            if len(rows) >= self._settings.min_points
        ]
        self._owned = np.zeros(len(points), dtype=bool)
        for body in people:
            self._owned[body.person.rows] = True
        view = self._view = ScanView(scene, ScanRays(points, viewpoint), scan.stamp, remember, scan.come)
        seen = {body.person.owner for body in people}
        unseen = {owner: middle for owner, middle in enumerate(middles) if owner not in seen}
        taken = [middle for owner, middle in enumerate(middles) if owner in seen]
        budget = FitBudget(self._settings.max_fits) if budget is None else budget
        offered = self._choose([candidate for candidate in candidates if not candidate.low], view)
        for number, owner in sorted(find_only_reached(offered, unseen, expected).items(), reverse=True):
            people.append(FoundBody(make(offered.pop(number)[0].rows, owner=owner), None))
            self._owned[people[-1].person.rows] = True
            taken.append(unseen.pop(owner))
        found, bent = self._fit_offered(offered, view, budget, ~self._owned)
        accepted: list[tuple[JudgedFit, Candidate]] = []
        fresh = take_apart(found, taken)
        while fresh:
            self._own(points, fresh)
            accepted += fresh
            fresh = take_apart(self._look_beside(fresh, view, budget), taken)
        posed, rejected = self._posed.find(candidates, view, self._owned, budget, self._settings.min_points)
        accepted += take_apart(posed, taken)
        self.last_rejected += rejected
        for judged, candidate in accepted:
            # Who stands at a wall may have no points by the prediction: the candidate there is that person.
            near = pop_nearest(unseen, judged.fit.vertices[:, :2].mean(axis=0))
            person = replace(make(candidate.rows, score=judged.probability, owner=near), floor=candidate.floor)
            people.append(FoundBody(person, replace(judged.fit, confidence=judged.confidence)))
        for candidate in bent:
            if all(np.hypot(*(candidate.middle - other)) > 2 * SAME_PERSON_M for other in taken):
                taken.append(candidate.middle)
                people.append(FoundBody(make(candidate.rows, score=0.0, proven=False), None))
        return people

    def _fit_offered(
        self, offered: Sequence[tuple[Candidate, float]], view: ScanView, budget: FitBudget, free: np.ndarray
    ) -> tuple[list[tuple[JudgedFit, Candidate]], list[Candidate]]:
        """Fit candidates with their probabilities by shape, and return who is a person, and who may be a bent one.

        `free` (N,) tells which points of the scan nobody has.
        """
        found, bent = [], []
        started: dict[int, FirstFit | None] = {}
        if budget.quick:
            some = [candidate for candidate, _ in offered[: budget.fits]]
            start = partial(self._start, view=view, quick=True)
            started = dict(enumerate(parallel_map(start, some, self._threads)))
        # In a live stream, who is found at once does not wait for what may be nobody.
        likely = sum(each is not None and self._is_proven(each.judged) for each in started.values())
        for number, (candidate, probability) in enumerate(offered):
            if not budget.spend():
                self.left_over = True
                break
            first = started[number] if budget.quick else self._start(candidate, view)
            if first is None:
                continue
            judged = first.judged
            worthwhile = judged.probability >= MIN_WORTHWHILE or probability >= MIN_SHAPELY
            if worthwhile and not (budget.quick and self._is_proven(judged)):
                if likely:
                    self.left_over = True
                    continue
                likely += budget.quick
                judged = self._try_others(first, candidate, view)
            stepped = None if self._is_stream else self._fit_on_step(candidate, view, judged)
            if stepped is not None:
                found.append(stepped)
                continue
            if self._is_proven(judged):
                limits = self._settings.min_points, budget.quick
                found.append(self._posed.improve(judged, candidate, view, free, *limits))
                budget.misses = 0
                continue
            self.last_rejected.append(
                RejectedCandidate.of(candidate, judged.probability, "no upright body explains it")
            )
            if view.remember:
                self._rejected.add(candidate, view.stamp)
            if self._may_be_bent(candidate, view.scene, probability):
                bent.append(candidate)
        return found, bent

    def _fit_on_step(
        self, candidate: Candidate, view: ScanView, judged: JudgedFit
    ) -> tuple[JudgedFit, Candidate] | None:
        """Return who stands on a step there, if that is likelier than what was `judged` on the floor.

        Not in a stream, in which they may come down.
        """
        raised = find_step(candidate, view, self._settings.min_points)
        first = None if raised is None else self._start(*raised)
        if raised is None or first is None:
            return None
        higher = self._try_others(first, *raised)
        least = judged.probability if self._is_proven(judged) else MIN_STEP
        is_better = higher.probability > least
        return (higher, raised[0]) if is_better else None

    def _own(self, points: np.ndarray, accepted: Sequence[tuple[JudgedFit, Candidate]]) -> None:
        """Note that people have the points of the scan (N, 3) m that lie on their bodies."""
        for judged, _ in accepted:
            self._owned |= find_beside(points, judged.fit.vertices, OWN_M)

    def _look_beside(
        self,
        accepted: Sequence[tuple[JudgedFit, Candidate]],
        view: ScanView,
        budget: FitBudget,
    ) -> list[tuple[JudgedFit, Candidate]]:
        """Return the people close beside others: what these leave may look like a person, and speak for one."""
        scene = view.scene
        middles = [judged.fit.vertices[:, :2].mean(axis=0) for judged, _ in accepted]
        near = [scene.index.find_near(scene.points, middle, BESIDE_M + CONTEXT_M)[0] for middle in middles]
        rows = np.unique(np.concatenate(near))
        rows = rows[~self._owned[rows]]
        if len(rows) < self._settings.min_points:
            return []
        left = view.take(rows)
        candidates, _ = find_candidates(left.scene, view.rays.viewpoint, self._settings.min_points)
        fresh = [
            candidate
            for candidate in candidates
            if any(np.hypot(*(candidate.middle - middle)) < BESIDE_M for middle in middles)
        ]
        found, _ = self._fit_offered(self._choose(fresh, left), left, budget, np.ones(len(rows), dtype=bool))
        if budget.quick:  # such a body leaves points of its own person, too
            found = [each for each in found if each[0].probability >= MIN_QUICK_BESIDE]
        return [(judged, replace(candidate, rows=rows[candidate.rows])) for judged, candidate in found]

    @one_blas_thread()
    def rate_floor(self, scene: SceneHeights, rays: ScanRays) -> float:
        """Return how well upright people explain what stands on the floor of a scene, seen by `rays`.

        Each person counts by how much they look like one and how close the body is; 0 where nobody stands there.
        """
        view = ScanView(scene, rays, 0, False, None)
        candidates, _ = find_candidates(scene, rays.viewpoint, self._settings.min_points)
        offered = self._choose(candidates, view)[:MAX_FLOOR_FITS]
        start = partial(self._start, view=view, quick=True)
        fits = parallel_map(start, [candidate for candidate, _ in offered], self._threads)
        proven = [
            (first.judged, candidate, likely * max(1.0 - first.found.cost / MAX_FLOOR_COST_M, 0.0))
            for first, (candidate, likely) in zip(fits, offered, strict=True)
            if first is not None and self._is_proven(first.judged)
        ]
        apart = {id(judged) for judged, _ in take_apart([each[:2] for each in proven], [])}
        return sum(judged.probability * weight for judged, _, weight in proven if id(judged) in apart)

    @one_blas_thread()
    def judge(
        self, person: PersonCloud, rows: np.ndarray, fit: BodyFit, turn: bool = False, quick: bool = False
    ) -> JudgedFit:
        """Return what the last scan says about the body of a person who is seen in its `rows` (N,).

        With `turn` also about one that faces the other way.

        Points of other people count neither for nor against it. Where it explains few points badly, a new upright body,
        a `quick` one or the best, may be better, and is returned instead. What is rejected is remembered as by `find`.
        """
        if self._view is None or not len(rows):
            return JudgedFit(0.0, 0.0, fit)
        view, rows = self._view.leave_to(rows, self._owned)
        candidate, seen = Candidate.of(view.scene, rows), see_candidate(self.upright, person.points, view.rays)
        if seen is None:
            return JudgedFit(0.0, 0.0, fit)
        cloud, window = seen
        judged = self._weigh(self.upright.rate(fit, cloud), cloud, candidate, view, window)
        posed = self._posed.judge(fit, cloud, candidate, view, window)
        if posed is not None:
            judged = max(judged, posed, key=lambda each: each.probability)
        if judged.probability < MIN_TRACKED and len(rows) < MIN_MANY_POINTS:
            other = self.upright.fit(cloud, candidate.floor, fit.state.rotation[0, :2, 0], quick)
            again = self._weigh(other, cloud, candidate, view, window)
            judged = max(judged, again, key=lambda each: each.probability)
        if judged.probability < self._settings.min_probability / 2:
            self._rejected.add(candidate, person.stamp)
        elif turn and judged.fit is fit:
            ahead = self.upright.refine([(0.0, fit.state)], cloud, candidate.floor)
            turned = self.upright.turn_round(fit.state, cloud, candidate.floor)
            return replace(judged, turned=(turned.fit, ahead.score - turned.score))
        return judged

    @one_blas_thread()
    def choose_facing(self, person: PersonCloud, first: BodyFit, full: BodyFit) -> BodyFit:
        """Return the body of a full fit to a person, or one that faces as the `first` one where that is likelier."""
        if person.viewpoint is None or person.floor is None:
            return full
        cloud = self.upright.make_cloud(person.points, person.viewpoint, None, person.field)
        return self.upright.choose_facing(first, full, cloud, person.floor)

    def _weigh(
        self,
        found: UprightFit,
        cloud: SingleViewCloud,
        candidate: Candidate,
        view: ScanView,
        window: np.ndarray,
    ) -> JudgedFit:
        evidence = weigh_fit(found, cloud, candidate, view.scene, view.rays, window, self._fitter.model)
        model = PersonModel.load()
        odds = COME_ODDS if view.has_come(candidate) else 0.0
        likely = 0.0 if evidence.between_others else model.judge_fit(evidence, odds)
        return JudgedFit(likely, model.rate(likely, evidence), found.fit)

    def _may_be_bent(self, candidate: Candidate, scene: SceneHeights, probability: float) -> bool:
        """Return whether a candidate may be a person who sits, bends or lifts the arms, for a full search to show."""
        if len(candidate.rows) < MIN_BENT_POINTS or probability < MIN_BENT_PROBABILITY or not candidate.whole:
            return False
        return person_score(scene.points[candidate.rows], None) >= MIN_BENT_SCORE

    def _choose(self, candidates: list[Candidate], view: ScanView) -> list[tuple[Candidate, float]]:
        """Return the candidates that are worth a fit with their probabilities by shape, the likeliest first."""
        shape = describe_candidates(candidates, view.scene, view.rays.viewpoint)
        probability = PersonModel.load().trees.predict(shape)
        chosen = []
        for number in np.argsort(-probability, kind="stable"):
            candidate, likely = candidates[number], float(probability[number])
            come = view.has_come(candidate)
            share = COME_FILTER if come else 1.0 if candidate.whole else COLUMN_FILTER
            if likely < self._settings.min_filter * share:
                self.last_rejected.append(RejectedCandidate.of(candidate, likely, "its shape is no person's"))
            elif view.remember and not come and self._rejected.contains(candidate, view.stamp):
                self.last_rejected.append(RejectedCandidate.of(candidate, likely, "rejected before"))
            else:
                chosen.append((candidate, likely))
        return chosen

    def _is_proven(self, judged: JudgedFit) -> bool:
        return judged.probability >= self._settings.min_probability

    def _start(self, candidate: Candidate, view: ScanView, quick: bool = False) -> FirstFit | None:
        """Fit the bank's best body, and judge it; None where no body can be fitted."""
        seen = see_candidate(self.upright, view.scene.points[candidate.rows], view.rays)
        if seen is None:
            return None
        cloud, window = seen
        starts = self.upright.find_rough(cloud, candidate.floor, quick=quick)
        found = self.upright.refine(starts[:1], cloud, candidate.floor)
        return FirstFit(cloud, window, starts[1:], found, self._weigh(found, cloud, candidate, view, window))

    def _try_others(self, first: FirstFit, candidate: Candidate, view: ScanView) -> JudgedFit:
        """Return the best of the bank's other bodies where it is better than the first, else the first."""
        if not first.others:
            return first.judged
        others = self.upright.refine(first.others, first.cloud, candidate.floor)
        if others.score < first.found.score:
            other = self._weigh(others, first.cloud, candidate, view, first.window)
            # Who is a person by one of both is one.
            if other.probability >= min(first.judged.probability, self._settings.min_probability):
                return other
        return first.judged
