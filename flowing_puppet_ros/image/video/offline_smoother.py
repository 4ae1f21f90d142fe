# SPDX-License-Identifier: Apache-2.0
"""Smooth the joints of every person of a clip along the flow, after the tracker has run through it.

Where a detector offers several hypotheses of the arms, the best path through them is taken first. Each image is seen
once; a few hundred numbers per person are kept of it, however large it is.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.image.arms.evidence import ARM_JOINTS, ArmEvidence
from flowing_puppet_ros.image.arms.hypotheses import ArmSmoother
from flowing_puppet_ros.image.arms.viterbi import ArmPathSettings
from flowing_puppet_ros.image.tracking.settings import SmoothingSettings
from flowing_puppet_ros.image.tracking.smoothing import flow_at_joints, smooth_joints
from flowing_puppet_ros.image.tracking.tracker import TrackedPuppet, TrackResult
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

DETECTOR_TRUST = 1 / 8
"""Weight of a joint of our detector against one of given keypoints: it errs more, and the flow must hold against it."""


@dataclass(slots=True, eq=False)
class _PuppetObservation:
    """A person in one image: the tracked `puppet` without its outlines, and its motion from the image before."""

    image: int
    puppet: TrackedPuppet
    body_energy: float
    motion: F64
    trust: F64


@dataclass(slots=True, eq=False)
class OfflineSmoother:
    """Collects the tracker's results of consecutive images and gives the smoothed people of each."""

    model: DeformableStructures
    settings: SmoothingSettings
    path: ArmPathSettings = field(default_factory=ArmPathSettings)
    images: int = 0
    _tracks: dict[str, list[_PuppetObservation]] = field(default_factory=lambda: defaultdict(list))
    _arms: dict[str, ArmSmoother] = field(default_factory=dict)

    def add(self, result: TrackResult, sights: Mapping[str, ArmEvidence] | None = None) -> None:
        """Take the result of the next image, and the `sights` of all its people where a detector has hypotheses."""
        for puppet in result.puppets:
            track = self._tracks[puppet.id]
            count = len(puppet.joints)
            motion, trust = np.zeros((count, 2)), np.zeros(count)
            if result.flow is not None and track and track[-1].image == self.images - 1:
                before, after = _sampled_joints(track[-1].puppet), _sampled_joints(puppet)
                motion, trust = flow_at_joints(result.flow, result.grid, before, after)
            if sights is not None:
                history = self._arms.setdefault(puppet.id, ArmSmoother(self.path))
                history.add(sights[puppet.id], result.flow if track else None, result.grid)
            energy = puppet.drawing.energy(puppet.shape)
            bare = replace(puppet, contours=(), shape=replace(puppet.shape, contours=()))
            track.append(_PuppetObservation(self.images, bare, energy, motion, trust))
        self.images += 1

    def people(self) -> Iterator[list[TrackedPuppet]]:
        """Yield the smoothed people of each image, in order."""
        people = {identity: self._smoothed(identity, track) for identity, track in self._tracks.items()}
        at = dict.fromkeys(self._tracks, 0)
        for image in range(self.images):
            found = []
            for identity, track in self._tracks.items():
                k = at[identity]
                if k < len(track) and track[k].image == image:
                    joints, right = people[identity]
                    found.append(self._puppet(track[k], joints[k], right[k]))
                    at[identity] = k + 1
            yield found

    def _smoothed(self, identity: str, track: list[_PuppetObservation]) -> tuple[F64, F64]:
        """Joints (T, J, 2) of one person, whose images are consecutive, and how probably (T, J) each is right.

        NaN where the tracker knows it best.
        """
        start = np.array([moment.puppet.joints for moment in track])
        scale = float(np.median([moment.puppet.scale for moment in track]))
        unknown = np.full((start.shape[1], 3), np.nan)
        detected = np.array([unknown if m.puppet.detected is None else m.puppet.detected for m in track])
        motion, trust = np.array([m.motion for m in track[1:]]), np.array([m.trust for m in track[1:]])
        right = np.full(detected.shape[:2], np.nan)
        if identity in self._arms:
            self._resolve_arms(self._arms[identity], detected, motion, right, scale)
            detected[..., 2] *= DETECTOR_TRUST
        confidence = np.where(np.isfinite(detected).all(axis=2), detected[..., 2], 0.0)
        if len(track) < 2 or not (confidence > 0).any():
            return start, right
        places = np.where(confidence[..., None] > 0, detected[..., :2], np.nan)
        joints = smooth_joints(places, confidence, motion, trust, start, scale, self.settings)
        # The body model has placed what nobody ever saw; along the flow alone it would drift.
        never = ~(confidence > 0).any(axis=0)
        joints[:, never] = start[:, never]
        return joints, right

    def _resolve_arms(self, arms: ArmSmoother, detected: F64, motion: F64, right: F64, scale: float) -> None:
        """Put the arms of the best path into the detected joints (T, J, 3), their motion (T-1, J, 2) and `right`."""
        for side, arm in arms.resolve(scale * self.model.shoulder_width).items():
            for k, name in enumerate(ARM_JOINTS):
                joint = self.model.joint_names.index(f"{side}_{name}")
                detected[:, joint, :2] = arm.places[:, k]
                detected[:, joint, 2] = arm.certainty
                right[:, joint] = arm.correctness[:, k]
                if len(motion):
                    motion[:, joint] = arm.motion[:-1, k]

    def _puppet(self, moment: _PuppetObservation, joints: F64, right: F64) -> TrackedPuppet:
        puppet = moment.puppet
        confidence = np.where(np.isfinite(right), right * puppet.visible, puppet.confidence)
        shape = puppet.drawing.puppet_from_joints(joints, puppet.scale, puppet.view)
        energy = puppet.energy - moment.body_energy + puppet.drawing.energy(shape)
        return replace(
            puppet, joints=joints, confidence=confidence, contours=shape.contours, shape=shape, energy=energy
        )


def _sampled_joints(puppet: TrackedPuppet) -> F64:
    """Return the joints at which the flow is sampled: the detected ones, else the tracked ones."""
    if puppet.detected is None:
        return puppet.joints
    return np.where(np.isfinite(puppet.detected[:, :2]), puppet.detected[:, :2], puppet.joints)
