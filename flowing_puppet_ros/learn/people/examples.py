# SPDX-License-Identifier: Apache-2.0
"""Candidates of labelled scans as examples: what they look like, what their fit says, and whether they are people."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.scans.scan import SUFFIXES, read_scan
from flowing_puppet_ros.body.scans.scene_labels import LabelledScene, label_scene, read_labels
from flowing_puppet_ros.body.segmentation.candidates import Candidate, SceneHeights, find_candidates
from flowing_puppet_ros.body.upright.candidate_shape import SHAPE_NAMES, describe_candidates
from flowing_puppet_ros.body.upright.scan_rays import ScanRays
from flowing_puppet_ros.body.upright.upright_fit import UprightFitter
from flowing_puppet_ros.body.upright.verification import FitEvidence, weigh_fit
from flowing_puppet_ros.errors import InputError

MIN_POINTS, MAX_RANGE_M = 25, 30.0
PERSON_M, NOBODY_M = 0.35, 0.7
"""Distance of a candidate from the next person up to which it is that person, and from which on it is none."""
MIN_PERSON_SHARE = 0.4  # of a person's points that a candidate must have to be that person
EVIDENCE = len(FitEvidence.__dataclass_fields__) - 1  # all but the outline


@dataclass(frozen=True, slots=True, eq=False)
class CandidateExamples:
    """Candidates of many scans.

    Attributes:
        shape: (N, len(SHAPE_NAMES)).
        evidence: (N, 7) of the fits, NaN where none was made.
        is_person: (N,) 1 for a person, 0 for none.
        scan: (N,) number of the scan.
    """

    shape: np.ndarray
    evidence: np.ndarray
    is_person: np.ndarray
    scan: np.ndarray


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
    fitter: BodyFitter, scenes: Iterator[tuple[np.ndarray, LabelledScene]], max_fits: int, seed: int
) -> CandidateExamples:
    """Make the examples of scans; of each, at most `max_fits` candidates that are no people are fitted."""
    upright, rng = UprightFitter(fitter), np.random.default_rng(seed)
    shapes, evidences, labels, scans = [], [], [], []
    for number, (points, truth) in enumerate(scenes):
        points = points - truth.sensor
        points = points[np.linalg.norm(points, axis=1) < MAX_RANGE_M]
        scene, viewpoint = SceneHeights.of(points), np.zeros(3)
        candidates, _ = find_candidates(scene, viewpoint, MIN_POINTS)
        own = np.array([_label(candidate, truth) for candidate in candidates])
        fitted = set(np.flatnonzero(own == 1)) | set(rng.permutation(np.flatnonzero(own == 0))[:max_fits])
        rays = ScanRays.of(points, viewpoint)
        shape = describe_candidates(candidates, scene, viewpoint)
        for row in np.flatnonzero(own >= 0):
            evidence = np.full(EVIDENCE, np.nan)
            if row in fitted:
                evidence = _weigh(upright, fitter, candidates[row], scene, rays)
            shapes.append(shape[row])
            evidences.append(evidence)
            labels.append(own[row])
            scans.append(number)
    return CandidateExamples(
        np.array(shapes).reshape(-1, len(SHAPE_NAMES)),
        np.array(evidences).reshape(-1, EVIDENCE),
        np.array(labels),
        np.array(scans),
    )


def _label(candidate: Candidate, truth: LabelledScene) -> int:
    """Return 1 for a person, 0 for none, -1 for what is neither clearly."""
    away = [float(np.hypot(*(person.middle - truth.sensor[:2] - candidate.middle))) for person in truth.people]
    nearest = int(np.argmin(away)) if away else -1
    if nearest < 0 or away[nearest] > NOBODY_M:
        return 0
    enough = len(candidate.rows) > MIN_PERSON_SHARE * truth.people[nearest].points
    return 1 if away[nearest] < PERSON_M and enough else -1


def _weigh(
    upright: UprightFitter, fitter: BodyFitter, candidate: Candidate, scene: SceneHeights, rays: ScanRays
) -> np.ndarray:
    points = scene.points[candidate.rows]
    window = rays.find_window(points)
    try:
        cloud = upright.make_cloud(points, rays.viewpoint, rays.find_unknown(points, window))
    except InputError:
        return np.full(EVIDENCE, np.nan)
    found = upright.fit(cloud, candidate.floor)
    return weigh_fit(found, candidate, scene, rays, window, fitter.model.faces).to_array()
