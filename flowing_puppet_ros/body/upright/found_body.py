# SPDX-License-Identifier: Apache-2.0
"""A person found in a scan with the first body, and the scan in which others are looked for."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.body.segmentation.candidates import Candidate, SceneHeights
from flowing_puppet_ros.body.upright.scan_rays import ScanRays
from flowing_puppet_ros.body.upright.upright_fit import UprightFit
from flowing_puppet_ros.model.sp import BodyState

MIN_COME_SHARE = 0.15
"""Share of the points, where the sensor once saw through, from which on something has come there."""
SAME_PERSON_M = 0.35  # between the middles of two bodies that are one person
SURROUNDINGS_M = 2.0  # about the middle of a person, of what may speak for or against one


@dataclass(frozen=True, slots=True, eq=False)
class FoundBody:
    """A person and the first body; without one, a person who is known already."""

    person: PersonCloud
    fit: BodyFit | None


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedPerson:
    """Somebody who is known: expected at a `place` (2,) m, within `reach` m of which they may be in a scan.

    `claims`: whether the body there tells which points are theirs, so that only who has none is looked for.
    """

    place: np.ndarray
    reach: float
    claims: bool


@dataclass(frozen=True, slots=True, eq=False)
class SearchedScan:
    """A scan in which people are looked for, and what is known of it.

    Attributes:
        scene: its N points, z up, within the range in which people are searched for; None without any.
        viewpoint: (3,) position of the sensor, metres.
        stamp: nanoseconds.
        normals: (N, 3) or None; only passed on.
        known: points (K, 3) in metres on each body that is expected in the scan, at its predicted position.
        expected: where these may be who are not seen there: a candidate that only one of them can have reached is
            theirs, and needs no fit. Nobody is where it is empty.
        come: which (N,) points lie where the scans before saw through; None where nothing is known.
    """

    scene: SceneHeights | None
    viewpoint: np.ndarray
    stamp: int = 0
    normals: np.ndarray | None = None
    known: Sequence[np.ndarray] = ()
    expected: Sequence[ExpectedPerson] = ()
    come: np.ndarray | None = None

    def make_person(
        self, rows: np.ndarray, score: float = 1.0, owner: int | None = None, proven: bool = True
    ) -> PersonCloud:
        """Return the person in some rows (N,) of the scene."""
        assert self.scene is not None
        return PersonCloud(
            self.scene.points[rows],
            None if self.normals is None else self.normals[rows],
            self.stamp,
            self.viewpoint,
            rows,
            score,
            owner,
            self.scene.floor.locate(*np.median(self.scene.points[rows, :2], axis=0)),
            proven=proven,
        )


@dataclass(frozen=True, slots=True, eq=False)
class JudgedFit:
    """A body: the `probability` that it is a person, and the `confidence` that it is one and close.

    Where it was asked for, `turned` is the body that faces the other way, and by how much that is better (m).
    """

    probability: float
    confidence: float
    fit: BodyFit
    turned: tuple[BodyFit, float] | None = None


class FirstFit(NamedTuple):
    """The bank's best body on a candidate: its cloud, the rays about it, other bodies to start from, and the result."""

    cloud: SingleViewCloud
    window: np.ndarray
    others: list[tuple[float, BodyState]]
    found: UprightFit
    judged: JudgedFit


@dataclass(frozen=True, slots=True, eq=False)
class ScanView:
    """A scan in which candidates are fitted.

    Attributes:
        scene: what is seen.
        rays: of the whole scan.
        stamp: nanoseconds.
        remember: whether what is no person is remembered.
        come: which (N,) of the scene's points lie where the sensor once saw through; None where nothing is known.
    """

    scene: SceneHeights
    rays: ScanRays
    stamp: int
    remember: bool
    come: np.ndarray | None

    def has_come(self, candidate: Candidate) -> bool:
        """Return whether a candidate stands where the sensor once saw through."""
        return self.come is not None and bool(self.come[candidate.rows].mean() > MIN_COME_SHARE)

    def leave_to(self, rows: np.ndarray, owned: np.ndarray) -> tuple[ScanView, np.ndarray]:
        """Return what is about the points `rows` (N,), ascending, without others that somebody has, and `rows` in it.

        `owned` tells of each point of the scan whether somebody has it.
        """
        middle = np.median(self.scene.points[rows, :2], axis=0)
        near = self.scene.index.find_near(self.scene.points, middle, SURROUNDINGS_M)[0]
        kept = np.union1d(rows, near[~owned[near]])
        return self.take(kept), np.searchsorted(kept, rows)

    def take(self, rows: np.ndarray) -> ScanView:
        """Return the part of the scan whose points are `rows` (K,), K > 0, of which nothing is remembered."""
        come = None if self.come is None else self.come[rows]
        return replace(self, scene=self.scene.take(rows), remember=False, come=come)


@dataclass(slots=True, eq=False)
class FitBudget:
    """How many bodies may still be fitted in a scan.

    Attributes:
        fits: candidates to which bodies are fitted.
        max_misses: so many of them in a row that are nobody end it; None: none does.
        quick: whether the bank's best body alone is fitted to a candidate that it proves to be a person, and its other
            bodies to one of those that it does not prove, where it proves nobody.
        misses: how many in a row were nobody so far.
    """

    fits: int
    max_misses: int | None = None
    quick: bool = False
    misses: int = 0

    def spend(self) -> bool:
        """Return whether there is one more, and take it; it counts as a miss until it is somebody."""
        if self.fits <= 0 or self.misses == self.max_misses:
            return False
        self.fits -= 1
        self.misses += 1
        return True


def take_apart(
    found: Sequence[tuple[JudgedFit, Candidate]], taken: list[np.ndarray]
) -> list[tuple[JudgedFit, Candidate]]:
    """Return the likeliest bodies that are not where another is, and add their middles (2,) m to those `taken`."""
    kept = []
    for judged, candidate in sorted(found, key=lambda each: -each[0].probability):
        middle = judged.fit.vertices[:, :2].mean(axis=0)
        if all(np.hypot(*(middle - other)) > SAME_PERSON_M for other in taken):
            taken.append(middle)
            kept.append((judged, candidate))
    return kept


def find_only_reached(
    offered: Sequence[tuple[Candidate, float]], unseen: Collection[int], expected: Sequence[ExpectedPerson]
) -> dict[int, int]:
    """Return which of the candidates can only be one of the people who are not seen, and can only be there.

    Args:
        offered: candidates, each with a probability.
        unseen: indices into `expected`.
        expected: where people may be; nobody is found where it is empty.
    """
    near = {
        owner: [
            number
            for number, (candidate, _) in enumerate(offered)
            if np.hypot(*(candidate.middle - expected[owner].place)) < expected[owner].reach
        ]
        for owner in unseen
        if expected
    }
    wanted = Counter(number for numbers in near.values() for number in numbers)
    return {numbers[0]: owner for owner, numbers in near.items() if len(numbers) == 1 and wanted[numbers[0]] == 1}


def pop_nearest(middles: dict[int, np.ndarray], place: np.ndarray) -> int | None:
    """Return whose middle (2,) m is so near to a place that they are one person, and take it out; None for nobody."""
    away = {owner: float(np.hypot(*(middle - place))) for owner, middle in middles.items()}
    nearest = min(away, key=away.__getitem__, default=None)
    if nearest is None or away[nearest] > SAME_PERSON_M:
        return None
    del middles[nearest]
    return nearest
