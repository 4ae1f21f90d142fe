# SPDX-License-Identifier: Apache-2.0
"""Whether what is tracked is a person: what the scans said about it so far, and whether it moved."""

from __future__ import annotations

from dataclasses import dataclass

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
    """

    first: F64
    odds: float = 0.0
    count: int = 0
    asked: int = 0
    confidence: float | None = None
    many: bool = False
    moved: bool = False
    shown: bool = False

    def is_due(self, stamp: int) -> bool:
        """Return whether the scan of a stamp in nanoseconds should be asked."""
        return self.count < EVERY_SCAN or stamp - self.asked >= LATER_NS or not self.shown

    def add(self, probability: float, confidence: float, stamp: int, points: int) -> None:
        """Take what the scan of a stamp in nanoseconds says by a number of points."""
        bounded = float(np.clip(probability, MIN_ODDS, 1 - MIN_ODDS))
        self.count, self.asked = min(self.count + 1, MAX_WEIGHT), stamp
        self.odds += (float(np.log(bounded / (1 - bounded))) - self.odds) / self.count
        self.confidence, self.many = confidence, points >= MIN_MANY_POINTS

    def visit(self, place: F64) -> None:
        """Take where (3,) m it is."""
        self.moved = self.moved or bool(np.hypot(*(place[:2] - self.first)) > MIN_MOVE_M)

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
        return self.shown

    @property
    def is_hopeless(self) -> bool:
        """Whether it is none; what has moved needs more evidence against it than what stands like furniture."""
        return self.count >= SEVERAL and self.probability < (HOPELESS / 2 if self.moved else HOPELESS)
