# SPDX-License-Identifier: Apache-2.0
"""Where a detector has to look in the next image of a stream: all over it, or only where the known people stand."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.image.detector.detection import PersonCandidate
from flowing_puppet_ros.image.video.tracklets import TrackletLinker

CONFIRMING_DETECTIONS = 5  # searches that must have found a person before only their place is looked at
MEMORY = 20  # searches that are remembered


@dataclass(slots=True, eq=False)
class KnownPeople:
    """Remembers what searches of whole images found; `searches` tells from all of them who is there."""

    searches: TrackletLinker
    _known: dict[str, tuple[float, float, int]] = field(default_factory=dict)

    def search(self, number: int, candidates: Sequence[PersonCandidate]) -> list[PersonCandidate]:
        """Take the candidates of image `number`, and tell from all searches up to now where people are in it."""
        self.searches.add(number, candidates)
        self.searches.keep(MEMORY)
        return [place for path in self.searches.paths() if (place := path.at(number)) is not None]

    def update(self, found: Mapping[str, PersonCandidate]) -> None:
        """Remember how large the people of a search are, by id, and how surely; forget whom it did not find.

        They are carried by the flow until another search finds them or the tracker gives them up.
        """
        looks = {identity: self._known[identity][2] + 1 if identity in self._known else 1 for identity in found}
        self._known = {identity: (place.scale, place.log_odds, looks[identity]) for identity, place in found.items()}

    def add(self, found: Mapping[str, PersonCandidate]) -> None:
        """Remember people who are new here as if a search had found them."""
        for identity, place in found.items():
            self._known.setdefault(identity, (place.scale, place.log_odds, 1))

    def known(self, people: Iterable[str]) -> bool:
        """Whether one of these people is known."""
        return any(identity in self._known for identity in people)

    def is_confirmed(self, people: Iterable[str]) -> bool:
        """Whether some of these people are known, and each of them from enough searches."""
        looks = [self._known[identity][2] for identity in people if identity in self._known]
        return min(looks, default=0) >= CONFIRMING_DETECTIONS

    def places(self, joint_names: Sequence[str], people: Mapping[str, F64]) -> dict[str, PersonCandidate]:
        """Where the known ones of these people are, whose joints (J, 2) px are given by id."""
        neck, face = (joint_names.index(name) for name in ("neck", "face"))
        return {
            identity: PersonCandidate(joints[neck], joints[face], *self._known[identity][:2])
            for identity, joints in people.items()
            if identity in self._known
        }
