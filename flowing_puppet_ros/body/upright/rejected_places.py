# SPDX-License-Identifier: Apache-2.0
"""Places where something stands that is no person, so that it is not fitted in every scan."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flowing_puppet_ros.body.segmentation.candidates import Candidate

RADIUS_M = 0.3
MAX_TOP_CHANGE_M, MAX_GROWTH = 0.15, 1.5
"""Change of the height of the top, and of the number of points, from which on something else stands there."""
MAX_PLACES = 1000


@dataclass(frozen=True, slots=True, eq=False)
class RejectedCandidate:
    """What is no person: its place (3,) m, its probability to be one, and why it was rejected."""

    place: np.ndarray
    probability: float
    reason: str

    @classmethod
    def of(cls, candidate: Candidate, probability: float, reason: str) -> RejectedCandidate:
        """Make it of a candidate."""
        return cls(np.array([*candidate.middle, candidate.floor]), float(probability), reason)

    def describe(self, rotation: np.ndarray, translation: np.ndarray) -> dict[str, Any]:
        """Return it for JSON, in a frame to which `rotation` (3, 3) and then `translation` (3,) m lead."""
        place = np.round(rotation @ self.place + translation, 3).tolist()
        return {"place": place, "probability": round(self.probability, 3), "reason": self.reason}


class RejectedPlaces:
    """What was rejected: place, top and number of points, until `keep` seconds later."""

    def __init__(self, keep: float) -> None:
        """Start empty."""
        self._keep_ns = int(1e9 * keep)
        self._places: list[tuple[np.ndarray, float, int, int]] = []

    def clear(self) -> None:
        """Forget everything."""
        self._places = []

    def add(self, candidate: Candidate, stamp: int) -> None:
        """Remember a candidate that is no person at a time in nanoseconds."""
        self._places.append((candidate.middle, candidate.top, len(candidate.rows), stamp))
        del self._places[:-MAX_PLACES]

    def contains(self, candidate: Candidate, stamp: int) -> bool:
        """Return whether the same was rejected at the same place not long ago."""
        self._places = [place for place in self._places if 0 <= stamp - place[3] <= self._keep_ns]
        count = len(candidate.rows)
        return any(
            np.hypot(*(middle - candidate.middle)) < RADIUS_M
            and abs(top - candidate.top) < MAX_TOP_CHANGE_M
            and 1 / MAX_GROWTH < count / points < MAX_GROWTH
            for middle, top, points, _ in self._places
        )
