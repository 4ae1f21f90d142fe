# SPDX-License-Identifier: Apache-2.0
"""Candidates of labelled scans as examples: what they look like, what their fit says, and whether they are people."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.scans.scan import SUFFIXES, read_scan
from flowing_puppet_ros.body.scans.scene_labels import LabelledScene, label_scene, read_labels
from flowing_puppet_ros.body.segmentation.candidates import Candidate, SceneHeights, find_candidates
from flowing_puppet_ros.body.upright.candidate_shape import describe_candidates
from flowing_puppet_ros.body.upright.found_body import ScanView
from flowing_puppet_ros.body.upright.posed_search import MAX_POSED_TOP_M, fit_posed, see_candidate
from flowing_puppet_ros.body.upright.scan_rays import ScanRays
from flowing_puppet_ros.body.upright.upright_fit import UprightFit, UprightFitter
from flowing_puppet_ros.body.upright.verification import EVIDENCE_NAMES, FitEvidence, weigh_fit
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.learn.people.unseen import predict_unseen

MIN_POINTS, MAX_RANGE_M = 25, 30.0
PERSON_M, NOBODY_M = 0.35, 0.7
"""Distance of a candidate from the next person up to which it is that person, and from which on it is none."""
POSED_PERSON_M, POSED_NOBODY_M = 0.5, 0.9  # the same where people sit on things, and reach out
MIN_PERSON_SHARE = 0.4  # of a person's points that a candidate must have to be that person
BODY_STRIDE = 8  # every so many vertices stand for a body, as for a tracker
MIN_ALIKE = 0.1
"""Probability of a person, by its shape, from which on something else is worth a fit."""


@dataclass(frozen=True, slots=True, eq=False)
class CandidateExamples:
    """Candidates of many scans.

    Attributes:
        shape: (N, len(SHAPE_NAMES)).
        evidence: (N, len(EVIDENCE_NAMES)) of the fits, NaN where none was made.
        tracked: the same of these bodies with the points that they have in a scan that follows, NaN where too few.
        is_person: (N,) 1 for a person, 0 for none.
        scan: (N,) number of the scan.
        joint_error: (N,) metres, mean error of the joints, NaN where none was fitted or nothing is known.
    """

    shape: np.ndarray
    evidence: np.ndarray
    tracked: np.ndarray
    is_person: np.ndarray
    scan: np.ndarray
    joint_error: np.ndarray

    @property
    def fitted(self) -> np.ndarray:
        """Which (N,) have a fit."""
        return np.asarray(np.isfinite(self.evidence).all(axis=1))


def read_scenes(folders: list[Path], turn: np.ndarray) -> Iterator[tuple[np.ndarray, LabelledScene]]:
    """Yield points (N, 3) m, z up by `turn` (3, 3), and labels of every scan of folders with a labels.json.

    Scans in a folder without one, and single files, show nobody.
    """
    for folder in folders:
        table = folder / "labels.json"
        labels = read_labels(table) if table.is_file() else {}
        paths = sorted(p for p in folder.iterdir() if p.suffix in SUFFIXES) if folder.is_dir() else [folder]
        if not paths:
            raise InputError(f"{folder} holds no scan; make some with `flowing-puppet evaluate scenes --write`")
        for path in paths:
            points = read_scan(path).points
            points = points if path.stem in labels else points @ turn.T
            yield points, label_scene(labels.get(path.stem, []), points, path.stem)


def collect_examples(
    fitter: BodyFitter,
    scenes: Iterator[tuple[np.ndarray, LabelledScene]],
    max_fits: int,
    seed: int,
    posed: bool = False,
) -> CandidateExamples:
    """Make the examples of scans; of each, people are fitted, and at most `max_fits` others that look like people.

    How much something looks like a person is what forests say that have not seen its scan. With `posed`, bodies are
    those of people who sit, bend or crouch.
    """
    upright = UprightFitter(fitter)
    seen: list[_SeenScan] = [_SeenScan.of(points, truth, posed) for points, truth in scenes]
    shape = np.concatenate([scan.shape for scan in seen])
    own = np.concatenate([scan.own for scan in seen])
    number = np.repeat(np.arange(len(seen)), [len(scan.own) for scan in seen])
    clear = np.flatnonzero(own >= 0)
    alike = np.zeros(len(own))
    alike[clear] = predict_unseen(shape[clear], own[clear], number[clear], seed)
    evidence, tracked = np.full((2, len(own), len(EVIDENCE_NAMES)), np.nan)
    joint_error = np.full(len(own), np.nan)
    first = 0
    for scan in tqdm(seen, desc="fits", unit="scan", file=sys.stderr):
        rows = first + np.arange(len(scan.own))
        first += len(rows)
        others = rows[(own[rows] == 0) & (alike[rows] > MIN_ALIKE)]
        others = others[np.argsort(-alike[others], kind="stable")][:max_fits]
        for row in np.sort(np.concatenate([rows[own[rows] == 1], others])):
            evidence[row], tracked[row], joint_error[row] = scan.weigh(upright, fitter, int(row - rows[0]))
    return CandidateExamples(
        shape[clear], evidence[clear], tracked[clear], own[clear], number[clear], joint_error[clear]
    )


@dataclass(frozen=True, slots=True, eq=False)
class _SeenScan:
    """The candidates of a scan, whether each is a person (1, 0, or -1 for what is neither clearly), and its shape."""

    scene: SceneHeights
    rays: ScanRays
    truth: LabelledScene
    candidates: list[Candidate]
    own: np.ndarray
    shape: np.ndarray
    posed: bool

    @classmethod
    def of(cls, points: np.ndarray, truth: LabelledScene, posed: bool) -> _SeenScan:
        points = points - truth.sensor
        points = points[np.linalg.norm(points, axis=1) < MAX_RANGE_M]
        viewpoint = np.zeros(3)
        scene = SceneHeights.of(points, viewpoint)
        candidates, _ = find_candidates(scene, viewpoint, MIN_POINTS, low=posed)
        candidates = [each for each in candidates if not posed or each.top < MAX_POSED_TOP_M]
        limits = (POSED_PERSON_M, POSED_NOBODY_M) if posed else (PERSON_M, NOBODY_M)
        own = np.array([_label(candidate, truth, *limits) for candidate in candidates], dtype=np.int64)
        shape = describe_candidates(candidates, scene, viewpoint)
        return cls(scene, ScanRays(points, viewpoint), truth, candidates, own, shape, posed)

    def weigh(self, upright: UprightFitter, fitter: BodyFitter, number: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the evidence of a candidate's fit, that of its body as if tracked, and the mean error of its joints.

        What there is not is NaN.
        """
        candidate, nothing = self.candidates[number], np.full(len(EVIDENCE_NAMES), np.nan)
        fitted = self._fit_posed(upright, fitter, candidate) if self.posed else self._fit(upright, fitter, candidate)
        if fitted is None:
            return nothing, nothing, np.nan
        found, evidence = fitted
        tracked = nothing
        known = [found.fit.vertices[::BODY_STRIDE]]
        rows = find_candidates(self.scene, self.rays.viewpoint, MIN_POINTS, known, only_known=True)[1].get(0)
        if rows is not None and len(rows) >= MIN_POINTS:
            other = Candidate.of(self.scene, np.sort(rows))
            seen = see_candidate(upright, self.scene.points[other.rows], self.rays)
            if seen is not None:
                again = upright.rate(found.fit, seen[0])
                tracked = weigh_fit(again, seen[0], other, self.scene, self.rays, seen[1], fitter.model).values
        return (
            evidence.values,
            tracked,
            self._measure_error(fitter, candidate, found.fit) if self.own[number] else np.nan,
        )

    def _fit(
        self, upright: UprightFitter, fitter: BodyFitter, candidate: Candidate
    ) -> tuple[UprightFit, FitEvidence] | None:
        """Return the upright body of a candidate with its evidence; None where the sensor stands in it."""
        seen = see_candidate(upright, self.scene.points[candidate.rows], self.rays)
        if seen is None:
            return None
        found = upright.fit(seen[0], candidate.floor)
        return found, weigh_fit(found, seen[0], candidate, self.scene, self.rays, seen[1], fitter.model)

    def _fit_posed(
        self, upright: UprightFitter, fitter: BodyFitter, candidate: Candidate
    ) -> tuple[UprightFit, FitEvidence] | None:
        """Return the posed body of a candidate with its evidence; None where there is none."""
        view = ScanView(self.scene, self.rays, 0, False, None)
        free = np.ones(len(self.scene.points), dtype=bool)
        fitted = fit_posed(upright, fitter.model, candidate, view, free, MIN_POINTS)
        return None if fitted is None else (fitted.found, fitted.evidence)

    def _measure_error(self, fitter: BodyFitter, candidate: Candidate, fit: BodyFit) -> float:
        """Return the mean distance (m) of a body's joints from those of the person who is nearest, NaN if unknown."""
        away = [np.hypot(*(p.middle - self.truth.sensor[:2] - candidate.middle)) for p in self.truth.people]
        person = self.truth.people[int(np.argmin(away))]
        places = dict(zip(fitter.model.joint_names, fit.joints + self.truth.sensor, strict=True))
        gaps = [np.linalg.norm(places[name] - place) for name, place in person.joints.items() if name in places]
        return float(np.mean(gaps)) if gaps else np.nan


def _label(candidate: Candidate, truth: LabelledScene, person: float, nobody: float) -> int:
    """Return 1 for a person, within so many metres, 0 for none, from so many on, -1 for what is neither clearly."""
    away = [float(np.hypot(*(person.middle - truth.sensor[:2] - candidate.middle))) for person in truth.people]
    nearest = int(np.argmin(away)) if away else -1
    if nearest < 0 or away[nearest] > nobody:
        return 0
    enough = len(candidate.rows) > MIN_PERSON_SHARE * truth.people[nearest].points
    return 1 if away[nearest] < person and enough else -1
