# SPDX-License-Identifier: Apache-2.0
"""The loop of the thesis over a whole clip: the tracker's results are collected, then searched person by person.

Long tracks are searched in segments to bound memory; a new segment also begins where a person was out of sight.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from flowing_puppet_ros.arrays import F64, U8
from flowing_puppet_ros.evidence.image.hands import HandDetectors
from flowing_puppet_ros.flow.estimate import FlowPair
from flowing_puppet_ros.image.arms.evidence import person_window
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.pose.evidence import KeypointPerson, LikelihoodLike, PersonHypotheses, PersonWindow
from flowing_puppet_ros.image.thesis_loop.energy import FrameEvidence
from flowing_puppet_ros.image.thesis_loop.flow_moments import FlowMoments
from flowing_puppet_ros.image.thesis_loop.hand_maps import make_hand_maps
from flowing_puppet_ros.image.thesis_loop.loop import InitialPose, ThesisLoop
from flowing_puppet_ros.image.thesis_loop.settings import EnergySettings, LoopSettings
from flowing_puppet_ros.image.tracking.propagation import ImageScale
from flowing_puppet_ros.image.tracking.tracker import TrackedPuppet, TrackResult
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.shape import View
from flowing_puppet_ros.process.threads import one_blas_thread

MAX_SEGMENT_IMAGES = 100
"""Maximum number of images of one person searched together; the evidence of an image takes about 5 MB."""


class EvidenceLike(Protocol):
    """A person in one image: image evidence and detection; for example `arms.evidence.ArmEvidence`."""

    @property
    def detection(self) -> PersonHypotheses | None:
        """Detection or given keypoints; None if there are none."""
        ...

    @property
    def window(self) -> PersonWindow | None:
        """Image evidence around the person; None outside of the image."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class KeypointEvidence:
    """A person in one image whose track was started from given keypoints."""

    detection: KeypointPerson | None
    window: PersonWindow | None


def evidence_from_keypoints(
    model: DeformableStructures,
    likelihood: LikelihoodLike,
    image: U8,
    result: TrackResult,
    given: Sequence[Keypoints] | None,
) -> dict[str, KeypointEvidence]:
    """Collect the evidence for the people in `result`, of a step on `image` (H, W, 3) and `given` keypoints, by id."""
    evidence = {}
    with one_blas_thread():
        for puppet in result.puppets:
            known = None if puppet.detection is None or given is None else given[puppet.detection]
            found = None if known is None else KeypointPerson(known, model.shoulder_width * puppet.scale)
            evidence[puppet.id] = KeypointEvidence(found, person_window(model, likelihood, image, puppet))
    return evidence


@dataclass(slots=True, eq=False)
class _Segment:
    """Consecutive images of one person: the tracked puppet and the evidence in each."""

    first: int
    puppets: list[TrackedPuppet] = field(default_factory=list)
    frames: list[FrameEvidence] = field(default_factory=list)


@dataclass(slots=True, eq=False)
class ThesisClip:
    """Collection of the tracker's results in consecutive images, and search for the people in all of them."""

    model: DeformableStructures
    hands: HandDetectors
    loop: LoopSettings = field(default_factory=LoopSettings)
    energy: EnergySettings = field(default_factory=EnergySettings)
    images: int = 0
    _segments: dict[str, _Segment] = field(default_factory=dict)
    _done: dict[int, dict[str, TrackedPuppet]] = field(default_factory=dict)

    def add(self, result: TrackResult, evidence: Mapping[str, EvidenceLike]) -> None:
        """Add the result in the next image, and the evidence for its people by id."""
        for puppet in result.puppets:
            segment = self._segments.get(puppet.id)
            if segment is not None and (
                segment.first + len(segment.frames) < self.images or len(segment.frames) >= MAX_SEGMENT_IMAGES
            ):
                self._search(self._segments.pop(puppet.id))
                segment = None
            if segment is None:
                segment = self._segments[puppet.id] = _Segment(self.images)
            self._extend(segment, puppet, evidence[puppet.id], result.flow, result.grid)
        self.images += 1

    def _extend(
        self, segment: _Segment, puppet: TrackedPuppet, evidence: EvidenceLike, flow: FlowPair | None, grid: ImageScale
    ) -> None:
        frame = FrameEvidence(evidence.window, None, evidence.detection)
        if evidence.window is not None and self.energy.hand_weight > 0:
            # The flow into the first image of a continued segment comes from outside of it, and still shows its hands.
            flows = [] if flow is None else [flow[1]]
            frame.hands = make_hand_maps(self.hands, evidence.window, flows, grid, puppet.scale)
        if (
            flow is not None
            and segment.frames
            and self.loop.max_propagated + self.energy.forward_flow + self.energy.backward_flow > 0
        ):
            low, high = _arm_reach_box(segment.puppets[-1], puppet)
            segment.frames[-1].after = FlowMoments.of(flow, grid, low, high)
            frame.before = FlowMoments.of((flow[1], flow[0]), grid, low, high)
        segment.frames.append(frame)
        segment.puppets.append(replace(puppet, contours=(), shape=replace(puppet.shape, contours=())))

    def people(self) -> Iterator[list[TrackedPuppet]]:
        """Search all segments, then yield the people in each image, in order."""
        for identity in list(self._segments):
            self._search(self._segments.pop(identity))
        for image in range(self.images):
            yield list(self._done.get(image, {}).values())

    def _search(self, segment: _Segment) -> None:
        views = [puppet.view for puppet in segment.puppets]
        view: View = "back" if views.count("back") > len(views) / 2 else "front"
        loop = ThesisLoop(self.model, view, self.loop, self.energy)
        starts = [InitialPose(puppet.joints, puppet.scale) for puppet in segment.puppets]
        with one_blas_thread():
            joints, agreement, energy = loop.run(starts, segment.frames)
        for k, puppet in enumerate(segment.puppets):
            shape = self.model.puppet_from_joints(joints[k], puppet.scale, view)
            confidence = np.minimum(agreement[k], np.where(puppet.confidence > 0, 1.0, 0.0))
            self._done.setdefault(segment.first + k, {})[puppet.id] = replace(
                puppet,
                joints=joints[k],
                confidence=confidence,
                view=view,
                contours=shape.contours,
                shape=shape,
                energy=float(energy[k]),
            )


def _arm_reach_box(*puppets: TrackedPuppet) -> tuple[F64, F64]:
    """Return the corners (2,) px of the box that the arms of `puppets` can reach."""
    joints = np.concatenate([puppet.joints for puppet in puppets])
    reach = 0.75 * max(puppet.scale for puppet in puppets)
    return joints.min(axis=0) - reach, joints.max(axis=0) + reach
