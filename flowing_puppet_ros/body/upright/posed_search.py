# SPDX-License-Identifier: Apache-2.0
"""People who sit, bend or crouch, where no upright body explains what is seen.

What they sit on is part of the candidate. So the best bodies are placed by what is highest, and only the points beside
the fitted body are the person's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.body.bank.body_bank import stature_cost
from flowing_puppet_ros.body.bank.posed_bank import is_posed
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.body.segmentation.candidates import Candidate
from flowing_puppet_ros.body.upright.candidate_shape import describe_candidates
from flowing_puppet_ros.body.upright.found_body import FitBudget, JudgedFit, ScanView
from flowing_puppet_ros.body.upright.person_model import POSED, PersonModel
from flowing_puppet_ros.body.upright.rejected_places import RejectedCandidate, RejectedPlaces
from flowing_puppet_ros.body.upright.scan_rays import ScanRays
from flowing_puppet_ros.body.upright.upright_fit import UprightFit, UprightFitter
from flowing_puppet_ros.body.upright.verification import FitEvidence, weigh_fit
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.cloud.nearest import find_beside
from flowing_puppet_ros.model.sp import StitchedPuppet

REACH_M, CLAIM_M, MIN_CLAIM_HEIGHT_M = 1.0, 0.1, 0.06
"""Distance from a candidate's middle up to which points may be the person's, from the body up to which they are, and
their height over the floor."""
MAX_FITS, MAX_STREAM_FITS, MAX_LIVE_FITS = 12, 4, 1
"""Bodies that are fitted in a scan by itself, of a recording, and of a live stream."""
STARTS = 4  # bodies of the bank that are refined
MAX_POSED_TOP_M, MIN_GAIN_M = 1.55, 0.006
"""Height of the top up to which somebody may sit, bend or crouch, and by how much closer than an upright body such a
body has to be."""
MIN_POSED = 0.8  # probability of who is posed: seats and what lies on them are people soon
MAX_OWNED_SHARE = 0.3  # of a candidate's points that somebody else may have


@dataclass(frozen=True, slots=True, eq=False)
class PosedFit:
    """A body, the points that it claims as a candidate, and what the scan says about it."""

    found: UprightFit
    claimed: Candidate
    evidence: FitEvidence


def fit_posed(
    upright: UprightFitter,
    model: StitchedPuppet,
    candidate: Candidate,
    view: ScanView,
    free: np.ndarray,
    min_points: int,
    quick: bool = False,
) -> PosedFit | None:
    """Fit the best posed body to a candidate; None where none can be fitted, or claims fewer than `min_points`.

    `free` (N,) tells which points of the scan nobody else has.
    """
    scene = view.scene
    seen = see_candidate(upright, scene.points[candidate.rows], view.rays)
    if seen is None:
        return None
    starts = upright.find_posed(seen[0], candidate.floor, quick)
    found = upright.refine(starts[: 1 if quick else STARTS], seen[0], candidate.floor)
    near = scene.index.find_near(scene.points, candidate.middle, REACH_M)[0]
    near = np.sort(near[free[near] & (scene.height[near] > MIN_CLAIM_HEIGHT_M)])
    rows = near[find_beside(scene.points[near], found.fit.vertices, CLAIM_M)]
    if len(rows) < min_points:
        return None
    claimed = Candidate.of(scene, rows)
    seen = see_candidate(upright, scene.points[rows], view.rays)
    if seen is None:
        return None
    return PosedFit(found, claimed, weigh_fit(found, seen[0], claimed, scene, view.rays, seen[1], model))


def see_candidate(
    upright: UprightFitter, points: np.ndarray, rays: ScanRays
) -> tuple[SingleViewCloud, np.ndarray] | None:
    """Return the cloud of points (N, 3) m, and the rays (M,) near them; None where the sensor stands in them."""
    window = rays.find_window(points)
    try:
        return upright.make_cloud(points, rays.viewpoint, rays.find_unknown(points, window)), window
    except InputError:
        return None


class PosedSearch:
    """Finds posed people among candidates, and remembers what was none."""

    def __init__(self, upright: UprightFitter, model: StitchedPuppet, min_filter: float, keep: float) -> None:
        """Fit with `upright`; `min_filter` as in `PersonFinderSettings`, what was nobody is kept for `keep` s."""
        self._upright, self._body_model = upright, model
        self._min_filter = min_filter
        self._rejected = RejectedPlaces(keep)

    def clear(self) -> None:
        """Forget what was nobody."""
        self._rejected.clear()

    def find(
        self,
        candidates: Sequence[Candidate],
        view: ScanView,
        owned: np.ndarray,
        budget: FitBudget,
        min_points: int,
    ) -> tuple[list[tuple[JudgedFit, Candidate]], list[RejectedCandidate]]:
        """Return posed people with their points, and what was fitted and is nobody.

        Args:
            candidates: in the scan.
            view: the scan.
            owned: (N,) which of its points somebody has.
            budget: of the upright bodies, by which the number of these goes.
            min_points: of a person.
        """
        left = [each for each in candidates if owned[each.rows].mean() < MAX_OWNED_SHARE]
        chosen = self._choose([each for each in left if each.top < MAX_POSED_TOP_M], view)
        found, rejected = [], []
        fits = MAX_LIVE_FITS if budget.quick else MAX_FITS if budget.max_misses is None else MAX_STREAM_FITS
        for candidate, likely in chosen[:fits]:
            fitted = fit_posed(self._upright, self._body_model, candidate, view, ~owned, min_points, budget.quick)
            judged = None if fitted is None else self.weigh(fitted.found.fit, fitted.evidence)
            if fitted is not None and judged is not None and judged.probability >= MIN_POSED:
                found.append((judged, fitted.claimed))
                continue
            probability = likely if judged is None else judged.probability
            rejected.append(RejectedCandidate.of(candidate, probability, "no body explains it"))
            if view.remember:
                self._rejected.add(candidate, view.stamp)
        return found, rejected

    def improve(
        self, judged: JudgedFit, candidate: Candidate, view: ScanView, free: np.ndarray, min_points: int, quick: bool
    ) -> tuple[JudgedFit, Candidate]:
        """Return an upright body with its candidate, or a posed one that is closer to what is too low for an adult.

        `free` (N,) tells which points of the scan nobody else has.
        """
        if candidate.top > MAX_POSED_TOP_M or not self._choose([candidate], replace(view, remember=False)):
            return judged, candidate
        fitted = fit_posed(self._upright, self._body_model, candidate, view, free, min_points, quick)
        seen = see_candidate(self._upright, view.scene.points[candidate.rows], view.rays)
        if fitted is None or seen is None:
            return judged, candidate
        posed = self.weigh(fitted.found.fit, fitted.evidence)
        upright = self._upright.rate(judged.fit, seen[0])
        # A child costs more than an adult who sits, but is as likely there.
        gain = upright.cost - _cost_stature(upright) - (fitted.found.cost - _cost_stature(fitted.found))
        if gain < MIN_GAIN_M or posed.probability < MIN_POSED:
            return judged, candidate
        return posed, fitted.claimed

    def judge(
        self, fit: BodyFit, cloud: SingleViewCloud, candidate: Candidate, view: ScanView, window: np.ndarray
    ) -> JudgedFit | None:
        """Return what a scan says about a body that is tracked; None where it stands or walks."""
        if not is_posed(dict(zip(self._body_model.joint_names, fit.joints, strict=True))):
            return None
        found = self._upright.rate(fit, cloud)
        return self.weigh(fit, weigh_fit(found, cloud, candidate, view.scene, view.rays, window, self._body_model))

    def weigh(self, fit: BodyFit, evidence: FitEvidence) -> JudgedFit:
        """Return what the evidence says about a body."""
        model = PersonModel.load(POSED)
        likely = 0.0 if evidence.between_others else model.judge_fit(evidence)
        return JudgedFit(likely, model.rate(likely, evidence), fit)

    def _choose(self, candidates: Sequence[Candidate], view: ScanView) -> list[tuple[Candidate, float]]:
        """Return the candidates that are worth a fit with their probabilities by shape, the likeliest first."""
        shape = describe_candidates(list(candidates), view.scene, view.rays.viewpoint)
        probability = PersonModel.load(POSED).trees.predict(shape)
        return [
            (candidates[number], float(probability[number]))
            for number in np.argsort(-probability, kind="stable")
            if probability[number] >= self._min_filter
            and not (view.remember and self._rejected.contains(candidates[number], view.stamp))
        ]


def _cost_stature(found: UprightFit) -> float:
    return float(stature_cost(np.array(found.stature)))
