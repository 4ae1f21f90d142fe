# SPDX-License-Identifier: Apache-2.0
"""One run of the detector on an image of a stream: on the full frame, or in the regions (ROIs) of known people.

A run is given all that it needs when it starts, so that it can go on beside the tracking of later images.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from flowing_puppet_ros.arrays import F64, Image
from flowing_puppet_ros.image.arms.evidence import ArmEvidenceModel
from flowing_puppet_ros.image.arms.hypotheses import ArmFilter
from flowing_puppet_ros.image.detector.detection import PersonCandidate, PersonDetection
from flowing_puppet_ros.image.detector.interface import DetectorLike
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.tracking.tracker import TrackedPuppet
from flowing_puppet_ros.image.video.known_people import KnownPeople
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.process.threads import one_opencv_thread

type ArmJoints = dict[int, tuple[F64, float]]
"""Elbows and wrists by their index in the model: the place (2,) px, and the probability that it is right."""

MAX_NECK_DISTANCE = 0.5
"""Shoulder widths between the detected and the tracked neck of one person."""


@dataclass(frozen=True, slots=True, eq=False)
class DetectedPerson:
    """A detection, its keypoints px, and for a tracked person the `identity` and the joints of the `arms`."""

    detection: PersonDetection
    keypoints: Keypoints
    identity: str | None = None
    arms: ArmJoints = field(default_factory=dict)

    @property
    def candidate(self) -> PersonCandidate:
        """Place of the person in the image that the keypoints are of."""
        neck, face = (self.keypoints.xy[self.keypoints.names.index(name)] for name in ("neck", "face"))
        return replace(self.detection.candidate, neck=neck, face=face)

    def move(self, move: Callable[[F64], F64]) -> DetectedPerson:
        """Return the person in another image, to which `move` takes points (K, 2) px; NaN where that is unknown."""
        joints = list(self.arms)
        places = move(np.array([self.arms[joint][0] for joint in joints]).reshape(-1, 2))
        arms = {joint: (place, self.arms[joint][1]) for joint, place in zip(joints, places, strict=True)}
        known = {joint: arm for joint, arm in arms.items() if np.isfinite(arm[0]).all()}
        keypoints = replace(self.keypoints, xy=move(self.keypoints.xy))
        return replace(self, keypoints=keypoints, arms=known)


@dataclass(frozen=True, slots=True, eq=False)
class DetectionWorker:
    """The detector, and the model that scores the arms of the people it finds."""

    detector: DetectorLike
    evidence_model: ArmEvidenceModel

    def detect_full_frame(self, image: Image, known: KnownPeople, number: int) -> list[DetectedPerson]:
        """Detect people anywhere in an image (H, W, 3); `known` records it as its full frame `number`."""
        # Results may depend on the number of threads otherwise.
        with one_opencv_thread():
            return self.detect_at(image, known.locate(number, self.detector.propose(image)))

    def detect_in_rois(
        self,
        image: Image,
        candidates: Sequence[PersonCandidate],
        puppets: Sequence[TrackedPuppet],
        arms: Mapping[str, ArmFilter],
    ) -> list[DetectedPerson]:
        """Detect people at some candidates only; the `arms` (by id) of the tracked `puppets` take what is seen."""
        with one_opencv_thread():
            people = self.detect_at(image, candidates)
            places = [person.detection.candidate for person in people]
            for index, puppet in match_to_tracks(places, puppets, self.evidence_model.model).items():
                joints = self.step_arms(arms[puppet.id], image, puppet, people[index].detection)
                people[index] = replace(people[index], identity=puppet.id, arms=joints)
        return people

    def detect_at(self, image: Image, candidates: Sequence[PersonCandidate]) -> list[DetectedPerson]:
        """Detect people at some candidates only."""
        with one_opencv_thread():
            found = self.detector.detect_at(image, candidates)
        return [DetectedPerson(detection, detection.keypoints) for detection in found]

    def step_arms(
        self, arms: ArmFilter, image: Image, puppet: TrackedPuppet, detection: PersonDetection | None
    ) -> ArmJoints:
        """Step the filter of a person's arms by what their image shows, and return the best joints."""
        with one_opencv_thread():
            return arms.step_joints(self.evidence_model.extract(image, puppet, detection))


def match_to_tracks(
    candidates: Sequence[PersonCandidate], puppets: Sequence[TrackedPuppet], model: DeformableStructures
) -> dict[int, TrackedPuppet]:
    """Return the tracked puppet at each candidate, by the candidate's index; each puppet is at one at most."""
    neck = model.joint_names.index("neck")
    pairs = [
        (float(np.hypot(*(candidate.neck - puppet.joints[neck]))) / candidate.scale, index, k)
        for index, candidate in enumerate(candidates)
        for k, puppet in enumerate(puppets)
    ]
    owners: dict[int, int] = {}
    for distance, index, k in sorted(pairs):
        if distance < MAX_NECK_DISTANCE and index not in owners and k not in owners.values():
            owners[index] = k
    return {index: puppets[k] for index, k in owners.items()}
