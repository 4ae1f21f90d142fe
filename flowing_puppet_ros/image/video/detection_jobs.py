# SPDX-License-Identifier: Apache-2.0
"""One look of the detector at an image of a stream whose people are tracked: a search for all, or a glance at some.

Everything that a look needs is given when it begins, so that it can run beside the tracking of later images.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64, Image
from flowing_puppet_ros.image.arms.evidence import ArmEvidenceModel
from flowing_puppet_ros.image.arms.hypotheses import ArmFilter
from flowing_puppet_ros.image.arms.viterbi import PathSettings
from flowing_puppet_ros.image.detector.detection import PersonCandidate, PersonDetection
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.tracking.tracker import TrackedPuppet
from flowing_puppet_ros.image.video.detection_memory import KnownPeople
from flowing_puppet_ros.image.video.tracking_by_detection import DetectorLike
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

type Ends = dict[int, tuple[F64, float]]
"""Of joints, by their index in the model: the place (2,) px, and the probability that it is right."""

SAME = 0.5  # shoulder widths between the necks of one person, as detected and as tracked


@dataclass(frozen=True, slots=True, eq=False)
class DetectedPerson:
    """Whom a look saw: `keypoints` of the `detection`, and of a tracked person the `identity` and the `arms`' ends."""

    detection: PersonDetection
    keypoints: Keypoints
    identity: str | None = None
    arms: Ends = field(default_factory=dict)

    @property
    def candidate(self) -> PersonCandidate:
        """Where the person stands in the image that the keypoints are of."""
        neck, face = (self.keypoints.xy[self.keypoints.names.index(name)] for name in ("neck", "face"))
        return replace(self.detection.place, neck=neck, face=face)

    def move(self, move: Callable[[F64], F64]) -> DetectedPerson:
        """The same in another image, to which `move` takes places (K, 2) px; NaN where it does not know."""
        joints = list(self.arms)
        places = move(np.array([self.arms[joint][0] for joint in joints]).reshape(-1, 2))
        arms = {joint: (place, self.arms[joint][1]) for joint, place in zip(joints, places, strict=True)}
        known = {joint: end for joint, end in arms.items() if np.isfinite(end[0]).all()}
        keypoints = replace(self.keypoints, xy=move(self.keypoints.xy))
        return replace(self, keypoints=keypoints, arms=known)


@dataclass(frozen=True, slots=True, eq=False)
class DetectionWorker:
    """The detector, and what judges the arms of the people that it finds."""

    detector: DetectorLike
    evidence_model: ArmEvidenceModel
    path: PathSettings = field(default_factory=PathSettings)

    def detect_full_frame(self, image: Image, watch: KnownPeople, number: int) -> list[DetectedPerson]:
        """Look for people all over an image (H, W, 3); `watch` takes the search as its image `number`."""
        # Results may depend on the number of threads otherwise.
        cv2.setNumThreads(1)
        found = self.detector.detect_at(image, watch.search(number, self.detector.propose(image)))
        return [DetectedPerson(detection, detection.keypoints) for detection in found]

    def detect_in_rois(
        self,
        image: Image,
        places: Sequence[PersonCandidate],
        puppets: Sequence[TrackedPuppet],
        arms: Mapping[str, ArmFilter],
    ) -> list[DetectedPerson]:
        """Look only at some places of an image in which `puppets` are tracked, whose `arms` by id take the look."""
        cv2.setNumThreads(1)
        found = self.detector.detect_at(image, places)
        owners = match_to_tracks([detection.place for detection in found], puppets, self.evidence_model.model)
        seen = []
        for index, detection in enumerate(found):
            if (puppet := owners.get(index)) is None:
                seen.append(DetectedPerson(detection, detection.keypoints))
                continue
            ends = arms[puppet.id].joints(self.evidence_model.evidence(image, puppet, detection))
            seen.append(DetectedPerson(detection, detection.keypoints, puppet.id, ends))
        return seen


def match_to_tracks(
    places: Sequence[PersonCandidate], puppets: Sequence[TrackedPuppet], model: DeformableStructures
) -> dict[int, TrackedPuppet]:
    """The tracked puppet that stands at each place, by the place's index; each puppet stands at one at most."""
    neck = model.joint_names.index("neck")
    pairs = [
        (float(np.hypot(*(place.neck - puppet.joints[neck]))) / place.scale, index, k)
        for index, place in enumerate(places)
        for k, puppet in enumerate(puppets)
    ]
    owners: dict[int, int] = {}
    for distance, index, k in sorted(pairs):
        if distance < SAME and index not in owners and k not in owners.values():
            owners[index] = k
    return {index: puppets[k] for index, k in owners.items()}
