# SPDX-License-Identifier: Apache-2.0
"""Evidence for the arms of one person in one image: scores of any arm position by detector, contours and colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from flowing_puppet_ros.arrays import F64, U8
from flowing_puppet_ros.evidence.image.likelihood import PartLikelihood
from flowing_puppet_ros.image.arms.viterbi import ArmPathSettings
from flowing_puppet_ros.image.detector.detection import PersonDetection
from flowing_puppet_ros.image.pose.evidence import LikelihoodLike, PersonWindow
from flowing_puppet_ros.image.tracking.tracker import TrackedPuppet
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.shape import View
from flowing_puppet_ros.process.threads import one_blas_thread

ARM_JOINTS = ("elbow", "wrist")


@dataclass(frozen=True, slots=True, eq=False)
class ArmEvidence:
    """One person in one image.

    `joints` (J, 2) px are as tracked, `scale` is in px/m, `detection` is None if the person was missed, and `window`,
    the image evidence around the person, is None outside of the image.
    """

    model: DeformableStructures
    joints: F64
    scale: float
    view: View
    detection: PersonDetection | None
    window: PersonWindow | None

    @property
    def shoulder_width_px(self) -> float:
        """Shoulder width in pixels."""
        return self.scale * self.model.shoulder_width

    def hypotheses(self, side: str, count: int) -> F64:
        """Return elbow and wrist (K, 2, 2) px of up to `count` modes of the detector; without it, the tracked ones."""
        if self.detection is not None:
            return self.detection.arm_hypotheses(side, count)
        return self.joints[None, [self.model.joint_names.index(f"{side}_{name}") for name in ARM_JOINTS]]

    def score(self, side: str, places: F64, settings: ArmPathSettings) -> F64:
        """Score elbow and wrist at `places` (K, 2, 2) px, (K,) nats."""
        score = np.zeros(len(places))
        if self.detection is not None:
            elbow, wrist = (
                self.detection.joint_score(f"{side}_{name}", places[:, k]) for k, name in enumerate(ARM_JOINTS)
            )
            score = settings.detector_weight * np.minimum(elbow, wrist)
        if self.window is not None and settings.evidence_weight > 0:
            score = score + settings.evidence_weight * self._window_score(self.window, side, places)
        return score

    @property
    def pose_score(self) -> float:
        """Score of the detected pose; NaN if the person was missed."""
        return np.nan if self.detection is None else self.detection.score

    def _window_score(self, window: PersonWindow, side: str, places: F64) -> F64:
        rows = [self.model.joint_names.index(f"{side}_{name}") for name in ARM_JOINTS]
        parts = [self.model.tree.names.index(f"{side}_{name}") for name in ("upper_arm", "lower_arm")]
        joints = np.repeat(self.joints[None], len(places), axis=0)
        joints[:, rows] = places
        scale = np.full(len(places), self.scale)
        contours, _ = self.model.puppets_from_joints(joints, scale, self.view, edges=())
        found = [window.log_likelihood(part, contours[part], scale) for part in parts]
        return np.asarray(found[0] + found[1])


def person_window(
    model: DeformableStructures, likelihood: LikelihoodLike, image: U8, puppet: TrackedPuppet
) -> PersonWindow | None:
    """Prepare the evidence around a puppet in `image` (H, W, 3), with its torso's and head's colours; None outside."""
    window = PersonWindow.around(likelihood, image, puppet.joints, puppet.scale)
    if window is None:
        return None
    torso, head = (puppet.contours[model.tree.names.index(name)] for name in ("torso", "head"))
    return window.with_torso(torso, head)


@dataclass(frozen=True, slots=True, eq=False)
class ArmEvidenceModel:
    """Image likelihood of arms, and the model of ten parts for which it was learned.

    A puppet with hands and feet has these parts and joints too, in front of its others.
    """

    model: DeformableStructures
    likelihood: LikelihoodLike

    @classmethod
    def load(cls, name: str) -> Self:
        """Load the model for puppets of a body model, "neutral", "female" or "male"."""
        return cls(DeformableStructures.load(name), PartLikelihood.load())

    def extract(self, image: U8, puppet: TrackedPuppet, detection: PersonDetection | None) -> ArmEvidence:
        """Extract the arm evidence of a tracked puppet, and its detection, in an image (H, W, 3) or (H, W)."""
        colour = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image
        # Sums of several BLAS threads would differ in their last bits.
        with one_blas_thread():
            window = person_window(self.model, self.likelihood, colour, puppet)
        joints = puppet.joints[: len(self.model.joint_names)]
        return ArmEvidence(self.model, joints, puppet.scale, puppet.view, detection, window)
