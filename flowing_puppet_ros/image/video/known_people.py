# SPDX-License-Identifier: Apache-2.0
"""The people that full-frame detections have found in a stream: where to detect them again."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.image.detector.detection import PersonCandidate
from flowing_puppet_ros.image.video.tracklets import TrackletLinker

MAX_FULL_FRAMES = 20
"""Full-frame detections that are remembered."""


@dataclass(slots=True, eq=False)
class KnownPeople:
    """Size and probability of the tracked people, and a `linker` that tells from several full frames who is there."""

    linker: TrackletLinker
    _known: dict[str, tuple[float, float, int]] = field(default_factory=dict)

    def locate(self, number: int, candidates: Sequence[PersonCandidate]) -> list[PersonCandidate]:
        """Record the candidates of full frame `number`; return where people are in it, by all full frames so far."""
        self.linker.add(number, candidates)
        self.linker.keep_last(MAX_FULL_FRAMES)
        return [place for tracklet in self.linker.link() if (place := tracklet.at(number)) is not None]

    def update(self, found: Mapping[str, PersonCandidate]) -> None:
        """Take size and probability of the people, by id, of a full frame; forget whom it did not find.

        The flow carries the forgotten on until a later full frame finds them or the tracker drops them.
        """
        counts = {identity: self._known[identity][2] + 1 if identity in self._known else 1 for identity in found}
        self._known = {identity: (place.scale, place.log_odds, counts[identity]) for identity, place in found.items()}

    def add(self, found: Mapping[str, PersonCandidate]) -> None:
        """Take people who are new, by id, as if a full frame had found them."""
        for identity, place in found.items():
            self._known.setdefault(identity, (place.scale, place.log_odds, 1))

    def are_confirmed(self, people: Iterable[str], full_frames: int) -> bool:
        """Return whether some of these people are known, and each of them from so many full frames."""
        counts = [self._known[identity][2] for identity in people if identity in self._known]
        return min(counts, default=0) >= full_frames

    def candidates(self, joint_names: Sequence[str], people: Mapping[str, F64]) -> dict[str, PersonCandidate]:
        """Return where the known ones of these people are, whose joints (J, 2) px are given by id."""
        neck, face = (joint_names.index(name) for name in ("neck", "face"))
        return {
            identity: PersonCandidate(joints[neck], joints[face], *self._known[identity][:2])
            for identity, joints in people.items()
            if identity in self._known
        }
