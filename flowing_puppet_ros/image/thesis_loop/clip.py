# SPDX-License-Identifier: Apache-2.0
"""A whole clip by the loop of the thesis: what the tracker saw is collected, and searched person by person.

Long tracks are searched in pieces, so that memory has a bound; a piece begins where a person was out of sight.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from flowing_puppet_ros.arrays import F64, U8
from flowing_puppet_ros.blas import one_blas_thread
from flowing_puppet_ros.evidence.image.hands import HandDetectors
from flowing_puppet_ros.flow.estimate import FlowPair
from flowing_puppet_ros.image.arms.evidence import person_window
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.pose.evidence import KeypointPerson, LikelihoodLike, PersonHypotheses, PersonWindow
from flowing_puppet_ros.image.thesis_loop.energy import EnergySettings, FrameEvidence
from flowing_puppet_ros.image.thesis_loop.flow_moments import FlowMoments
from flowing_puppet_ros.image.thesis_loop.hand_maps import hand_maps
from flowing_puppet_ros.image.thesis_loop.loop import InitialPose, LoopSettings, ThesisLoop
from flowing_puppet_ros.image.tracking.propagation import ImageScale
from flowing_puppet_ros.image.tracking.tracker import TrackedPuppet, TrackResult
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.shape import View

LONGEST = 100
"""Images of one person that are searched together; the evidence of an image takes about 5 MB."""


class EvidenceLike(Protocol):
    """A person in one image: the evidence around them, and who was detected; `arms.Sight` is one."""

    @property
    def detection(self) -> PersonHypotheses | None:
        """The detection or the given keypoints; None where there are none."""
        ...

    @property
    def window(self) -> PersonWindow | None:
        """The evidence around the person; None outside of the image."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class KeypointEvidence:
    """A person in one image who was started from given keypoints."""

    detection: KeypointPerson | None
    window: PersonWindow | None


def evidence_from_keypoints(
    model: DeformableStructures,
    likelihood: LikelihoodLike,
    image: U8,
    result: TrackResult,
    given: Sequence[Keypoints] | None,
) -> dict[str, KeypointEvidence]:
    """How the people of a step that took `given` keypoints are seen in its image (H, W, 3), by id."""
    sights = {}
    with one_blas_thread():
        for puppet in result.puppets:
            known = None if puppet.detection is None or given is None else given[puppet.detection]
            found = None if known is None else KeypointPerson(known, model.shoulder_width * puppet.scale)
            sights[puppet.id] = KeypointEvidence(found, person_window(model, likelihood, image, puppet))
    return sights


@dataclass(slots=True, eq=False)
class _Segment:
    """Consecutive images of one person: the tracked puppets and the evidence of each."""

    first: int
    puppets: list[TrackedPuppet] = field(default_factory=list)
    frames: list[FrameEvidence] = field(default_factory=list)


@dataclass(slots=True, eq=False)
class ThesisClip:
    """Collects the tracker's results of consecutive images and searches the people of all of them."""

    model: DeformableStructures
    hands: HandDetectors
    loop: LoopSettings = field(default_factory=LoopSettings)
    energy: EnergySettings = field(default_factory=EnergySettings)
    images: int = 0
    _pieces: dict[str, _Segment] = field(default_factory=dict)
    _done: dict[int, dict[str, TrackedPuppet]] = field(default_factory=dict)

    def add(self, result: TrackResult, sights: Mapping[str, EvidenceLike]) -> None:
        """Take the result of the next image, and how its people are seen."""
        for puppet in result.puppets:
            piece = self._pieces.get(puppet.id)
            if piece is not None and (piece.first + len(piece.frames) < self.images or len(piece.frames) >= LONGEST):
                self._search(self._pieces.pop(puppet.id))
                piece = None
            if piece is None:
                piece = self._pieces[puppet.id] = _Segment(self.images)
            self._extend(piece, puppet, sights[puppet.id], result.flow, result.grid)
        self.images += 1

    def _extend(
        self, piece: _Segment, puppet: TrackedPuppet, seen: EvidenceLike, flow: FlowPair | None, grid: ImageScale
    ) -> None:
        frame = FrameEvidence(seen.window, None, seen.detection)
        if seen.window is not None and self.energy.hand_weight > 0:
            # A piece that goes on begins with an image whose flow leads out of it, and keeps its hands.
            flows = [] if flow is None else [flow[1]]
            frame.hands = hand_maps(self.hands, seen.window, flows, grid, puppet.scale)
        if flow is not None and piece.frames and self.loop.carried + self.energy.forward + self.energy.backward > 0:
            low, high = _extent(piece.puppets[-1], puppet)
            piece.frames[-1].after = FlowMoments.of(flow, grid, low, high)
            frame.before = FlowMoments.of((flow[1], flow[0]), grid, low, high)
        piece.frames.append(frame)
        piece.puppets.append(replace(puppet, contours=(), shape=replace(puppet.shape, contours=())))

    def people(self) -> Iterator[list[TrackedPuppet]]:
        """The people of each image, in the order of the images."""
        for identity in list(self._pieces):
            self._search(self._pieces.pop(identity))
        for image in range(self.images):
            yield list(self._done.get(image, {}).values())

    def _search(self, piece: _Segment) -> None:
        views = [puppet.view for puppet in piece.puppets]
        view: View = "back" if views.count("back") > len(views) / 2 else "front"
        loop = ThesisLoop(self.model, view, self.loop, self.energy)
        starts = [InitialPose(puppet.joints, puppet.scale) for puppet in piece.puppets]
        with one_blas_thread():
            joints, agreed, energy = loop.run(starts, piece.frames)
        for k, puppet in enumerate(piece.puppets):
            shape = self.model.puppet_from_joints(joints[k], puppet.scale, view)
            confidence = np.minimum(agreed[k], np.where(puppet.confidence > 0, 1.0, 0.0))
            self._done.setdefault(piece.first + k, {})[puppet.id] = replace(
                puppet,
                joints=joints[k],
                confidence=confidence,
                view=view,
                contours=shape.contours,
                shape=shape,
                energy=float(energy[k]),
            )


def _extent(*puppets: TrackedPuppet) -> tuple[F64, F64]:
    """Corners (2,) px of what the arms of puppets can reach."""
    joints = np.concatenate([puppet.joints for puppet in puppets])
    reach = 0.75 * max(puppet.scale for puppet in puppets)
    return joints.min(axis=0) - reach, joints.max(axis=0) + reach
