# SPDX-License-Identifier: Apache-2.0
"""Whether what is tracked is a person: what the scans said about it so far, and whether it moved."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.body.upright.upright_fit import MIN_MANY_POINTS

SURE, CONFIRMED, MOVED_CONFIRMED, HOPELESS = 0.75, 0.6, 0.3, 0.2
"""Mean probabilities of a person: from which one scan is enough; from which several are; the same for what has moved;
and below which several show that it is none."""
MANY_SURE, MANY_CONFIRMED = 0.9, 0.8
"""The first two where many points are seen: they leave little doubt about people, and furniture is near the sensor."""
SEVERAL = 2  # scans
MAX_WEIGHT = 20  # scans that the mean reaches back
MIN_MOVE_M = 0.5  # from the first place on, which furniture does not get by the noise of its points
EVERY_SCAN, LATER_NS = 6, 1_000_000_000
"""Scans of which each is asked, and time between those asked later on."""
MIN_ODDS = 0.02
FACING_SCANS = 4  # asked, the first one included, that decide together whether somebody is turned round
MIN_WANDER_SCANS, MAX_WANDER_SCANS, MAX_GAP_NS = 30, 60, 300_000_000
"""Scans that show whether something sways, after which that is looked at anew, and time between two of them beyond
which they do not show it."""
MAX_STILL_RATIO, STILL_ODDS = 1.35, 2.5
"""How much more the place of something that stands still varies than it jumps, and the log odds against a person by
that. Of things it is 0.8 to 1.3, of people who stand as in motion capture 1.5 to 60."""


@dataclass(slots=True, eq=False)
class Wander:
    """Whether something that stands sways as people do, or its place only varies by the sensor's noise.

    Noise differs from scan to scan by as much as it varies in all; a body sways slowly, so that its place differs
    little from scan to scan and varies more in all (von Neumann, 1941). That ratio needs no sensor's noise.

    Attributes:
        places: (3,) metres, of the scans that are compared.
        stamp: nanoseconds, of the last.
        still: whether the last scans that showed it showed something still.
    """

    places: list[F64] = field(default_factory=list)
    stamp: int = 0
    still: bool = False

    def add(self, place: F64, stamp: int) -> None:
        """Take where (3,) m it is at a time in nanoseconds."""
        if len(self.places) == MAX_WANDER_SCANS or stamp - self.stamp > MAX_GAP_NS:
            self.places = []
        self.places.append(place)
        self.stamp = stamp
        if len(self.places) >= MIN_WANDER_SCANS:
            self.still = measure_wander(np.array(self.places)) < MAX_STILL_RATIO


def measure_wander(places: np.ndarray) -> float:
    """Return the variance of places (N, 3), relative to half the mean square of the steps between them."""
    steps = float((np.diff(places, axis=0) ** 2).sum(axis=1).mean()) / 2
    return float(places.var(axis=0).sum()) / max(steps, 1e-12)


@dataclass(slots=True, eq=False)
class PersonBelief:
    """What is believed of one track.

    Attributes:
        first: (2,) metres, where it was first.
        odds: mean log odds of a person.
        count: scans that were asked, at most `MAX_WEIGHT`.
        asked: stamp of the last of them, nanoseconds.
        confidence: of the last body, that it is a person and close; None before.
        many: whether the last scan that was asked showed many points of it.
        moved: whether it was far from its first place.
        shown: whether it ever was taken for a person.
        wander: whether it sways.
        backward: metres, by how much the scans that were asked prefer a body that is turned round.
    """

    first: F64
    odds: float = 0.0
    count: int = 0
    asked: int = 0
    confidence: float | None = None
    many: bool = False
    moved: bool = False
    shown: bool = False
    wander: Wander = field(default_factory=Wander)
    backward: float = 0.0

    def is_due(self, stamp: int) -> bool:
        """Return whether the scan of a stamp in nanoseconds should be asked."""
        return self.count < EVERY_SCAN or stamp - self.asked >= LATER_NS or not self.shown

    def add(self, probability: float, confidence: float, stamp: int, points: int) -> None:
        """Take what the scan of a stamp in nanoseconds says by a number of points."""
        bounded = float(np.clip(probability, MIN_ODDS, 1 - MIN_ODDS))
        self.count, self.asked = min(self.count + 1, MAX_WEIGHT), stamp
        self.odds += (float(np.log(bounded / (1 - bounded))) - self.odds) / self.count
        self.confidence, self.many = confidence, points >= MIN_MANY_POINTS

    def visit(self, points: F64, stamp: int, sensor_moves: bool = False) -> None:
        """Take its points (N, 3) m at a time in nanoseconds; where the sensor moves, everything does."""
        place = np.median(points, axis=0)
        if sensor_moves:
            self.first, self.moved = place[:2], False
            return
        self.wander.add(points.mean(axis=0), stamp)
        self.moved = self.moved or bool(np.hypot(*(place[:2] - self.first)) > MIN_MOVE_M)

    def asks_facing(self, points: int) -> bool:
        """Return whether the next scan should be asked which way somebody faces, with so many points.

        The first scans are, unless a walk shows it; many points are seldom wrong, and a body takes longer on them.
        """
        return not self.moved and self.count < FACING_SCANS and points < MIN_MANY_POINTS

    def turns(self, preference: float) -> bool:
        """Take by how much a scan prefers a body that is turned round, in metres, and return whether it should be."""
        self.backward += preference
        if self.count < FACING_SCANS or self.backward < 0:
            return False
        self.backward = -self.backward
        return True

    @property
    def probability(self) -> float:
        """Of a person."""
        return float(1 / (1 + np.exp(-self.odds)))

    def decide(self) -> bool:
        """Return whether it is taken for a person; who once was stays one until it is hopeless."""
        sure, confirmed = (MANY_SURE, MANY_CONFIRMED) if self.many else (SURE, CONFIRMED)
        limit = MOVED_CONFIRMED if self.moved else confirmed
        enough = self.probability >= (limit if self.count >= SEVERAL else sure)
        self.shown = (self.shown and not self.is_hopeless) or enough
        if self.wander.still and not self.moved:  # it stays known, or it would be found anew
            self.shown = self.odds > STILL_ODDS
        return self.shown

    @property
    def is_hopeless(self) -> bool:
        """Whether it is none; what has moved needs more evidence against it than what stands like furniture."""
        return self.count >= SEVERAL and self.probability < (HOPELESS / 2 if self.moved else HOPELESS)
