# SPDX-License-Identifier: Apache-2.0
"""The flowing-puppet tracker with a detector of its own: who is where in a video that nobody has looked at before."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

from flowing_puppet_ros.arrays import U8
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.flow.estimate import FlowPair
from flowing_puppet_ros.image.arms.evidence import ArmEvidence, ArmEvidenceModel
from flowing_puppet_ros.image.arms.hypotheses import ArmFilter
from flowing_puppet_ros.image.arms.viterbi import PathSettings
from flowing_puppet_ros.image.detector.detection import PersonCandidate, PersonDetection
from flowing_puppet_ros.image.detector.part_detector import DetectorSettings
from flowing_puppet_ros.image.tracking.tracker import FlowingPuppetTracker, TrackResult
from flowing_puppet_ros.image.video.detection_memory import KnownPeople
from flowing_puppet_ros.image.video.tracklets import FIRST, Tracklet, TrackletLinker
from flowing_puppet_ros.settings import Settings, setting


@dataclass(frozen=True)
class DetectionSettings(Settings):
    """When the detector looks at an image of a video."""

    detect_every: int = setting(1, "images from one look of the detector to the next", low=1, high=10000)
    least_person: float = setting(
        0.3, "probability from which a detected person is tracked; the surest needs a third of it", low=0.0, high=1.0
    )
    search_every: int = setting(
        2, "images from one search for people to the next where a whole clip is known", low=1, high=10000
    )
    renew_every: int = setting(
        10, "images from one search for people to the next while some are tracked live", low=1, high=10000
    )


class DetectorLike(Protocol):
    """What finds people in one image, see `detector.PartDetector`."""

    def detect(self, image: U8, settings: DetectorSettings) -> list[PersonDetection]:
        """The people in an image, the surest first."""
        ...

    def propose(self, image: U8) -> list[PersonCandidate]:
        """All places in an image where people may be."""
        ...

    def detect_at(self, image: U8, places: Sequence[PersonCandidate]) -> list[PersonDetection]:
        """The best pose at each of some places."""
        ...


@dataclass(slots=True, eq=False)
class DetectingTracker:
    """Runs the detector on the images of a video and the tracker on what it finds."""

    tracker: FlowingPuppetTracker
    detector: DetectorLike
    evidence_model: ArmEvidenceModel
    settings: DetectionSettings
    path: PathSettings = field(default_factory=PathSettings)
    images: int = 0
    _watch: KnownPeople = field(init=False)
    _arms: dict[str, ArmFilter] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Know nobody yet."""
        self._forget()

    def step(
        self,
        image: U8,
        stamp_ns: int,
        flow: FlowPair | None = None,
        paths: Sequence[Tracklet] | None = None,
    ) -> tuple[TrackResult, list[PersonDetection]]:
        """Take the next `image` (H, W, 3) RGB or (H, W) grey; the result, and whom the detector found if it looked.

        `flow` is as `FlowingPuppetTracker.step` takes it. Where the whole clip was searched before, the detector looks
        only where the `paths` of its people lead.
        """
        number = self.images
        self.images += 1
        if paths is not None:
            found = self.detector.detect_at(image, [place for path in paths if (place := path.at(number)) is not None])
            return self._tracked(image, stamp_ns, flow, found), found
        if number % self.settings.detect_every:
            return self._tracked(image, stamp_ns, flow, None), []
        people = {person.id: person.mean for person in self.tracker.people}
        searched = number % self.settings.renew_every == 0 or not self._watch.is_confirmed(people)
        places = [] if searched else list(self._watch.places(self.tracker.model.joint_names, people).values())
        found = self._searched(image, number) if searched else self.detector.detect_at(image, places)
        result = self._tracked(image, stamp_ns, flow, found)
        if result.restarted:
            # Nobody stands any more where they stood before a cut.
            self._forget()
            searched, found = True, self._searched(image, number)
            self.tracker.reset()
            again = self._tracked(image, stamp_ns, None, found)
            result = replace(again, warnings=result.warnings, restarted=True)
        result = self._refine_arms(result, image, found)
        if searched:
            seen = {puppet.id: puppet.detection for puppet in result.puppets}
            self._watch.update({name: found[index].place for name, index in seen.items() if index is not None})
        return result, found

    def _tracked(
        self,
        image: U8,
        stamp_ns: int,
        flow: FlowPair | None,
        found: Sequence[PersonDetection] | None,
    ) -> TrackResult:
        keypoints = None if found is None else [person.keypoints for person in found]
        result = self.tracker.step(image, stamp_ns, keypoints, flow)
        for arms in self._arms.values():
            arms.propagate(result.flow, result.grid)
        return result

    def _refine_arms(self, result: TrackResult, image: U8, found: Sequence[PersonDetection]) -> TrackResult:
        """The result of a live step with the arms where the best paths of their hypotheses lead."""
        sights = self.arm_evidence(image, result, found)
        self._arms = {identity: self._arms.get(identity, ArmFilter(self.path)) for identity in sights}
        places = {identity: self._arms[identity].joints(sight) for identity, sight in sights.items()}
        return self.tracker.override_joints(result, places)

    def _searched(self, image: U8, number: int) -> list[PersonDetection]:
        """Search the image for people; where they are is told from all searches up to now."""
        return self.detector.detect_at(image, self._watch.search(number, self.detector.propose(image)))

    def _forget(self) -> None:
        """Begin with no search."""
        self._watch = KnownPeople(self._empty(self.settings.search_every))

    def search(self, images: Iterable[U8]) -> list[Tracklet]:
        """Look for the people of a whole clip before it is tracked; images that cannot be used are passed over."""
        every = self.settings.search_every
        clip = self._empty(every)
        for number, image in enumerate(images):
            if number % every == 0:
                with contextlib.suppress(InputError):
                    clip.add(number, self.detector.propose(image))
        return clip.paths()

    def _empty(self, every: int) -> TrackletLinker:
        return TrackletLinker(self.settings.least_person, self.tracker.settings.most_people, every)

    def arm_evidence(self, image: U8, result: TrackResult, found: Sequence[PersonDetection]) -> dict[str, ArmEvidence]:
        """How each person of a step is seen in its image, by id; only hypotheses need this, tracking does not."""
        seen = [(puppet, None if puppet.detection is None else found[puppet.detection]) for puppet in result.puppets]
        return {puppet.id: self.evidence_model.evidence(image, puppet, detection) for puppet, detection in seen}

    def detect(self, image: U8) -> list[PersonDetection]:
        """The people in an image who are sure enough to be tracked; the surest one may be less sure."""
        people, least = min(self.tracker.settings.most_people, 80), self.settings.least_person
        settings = DetectorSettings(least_confidence=FIRST * least, most_people=people, mirrored=False)
        found = self.detector.detect(image, settings)
        return [person for turn, person in enumerate(found) if turn == 0 or person.confidence >= least]
