# SPDX-License-Identifier: Apache-2.0
"""How one person is seen in one image: what the detector and the evidence say of any place of the arms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from flowing_puppet_ros.arrays import F64, U8
from flowing_puppet_ros.blas import one_blas_thread
from flowing_puppet_ros.evidence.image.likelihood import PartLikelihood
from flowing_puppet_ros.image.arms.viterbi import PathSettings
from flowing_puppet_ros.image.detector.detection import PersonDetection
from flowing_puppet_ros.image.pose.evidence import LikelihoodLike, PersonWindow
from flowing_puppet_ros.image.tracking.tracker import TrackedPuppet
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.shape import View

ARM_JOINTS = ("elbow", "wrist")


@dataclass(frozen=True, slots=True, eq=False)
class ArmEvidence:
    """A person in one image.

    `joints` (J, 2) px as tracked, the `detection` (None where it was missed), and the evidence around the person (None
    outside of the image).
    """

    model: DeformableStructures
    joints: F64
    scale: float
    view: View
    detection: PersonDetection | None
    window: PersonWindow | None

    @property
    def width(self) -> float:
        """Shoulder width in px."""
        return self.scale * self.model.shoulder_width

    def hypotheses(self, side: str, count: int) -> F64:
        """Elbow and wrist (K, 2, 2) px of the detector's modes of an arm; without it the tracked ones."""
        if self.detection is not None:
            return self.detection.arms(side, count)
        return self.joints[None, [self.model.joint_names.index(f"{side}_{name}") for name in ARM_JOINTS]]

    def score(self, side: str, places: F64, settings: PathSettings) -> F64:
        """Score (K,) in nats of elbow and wrist at places (K, 2, 2) px."""
        score = np.zeros(len(places))
        if self.detection is not None:
            elbow, wrist = (
                self.detection.joint_score(f"{side}_{name}", places[:, k]) for k, name in enumerate(ARM_JOINTS)
            )
            score = settings.detector_weight * np.minimum(elbow, wrist)
        if self.window is not None and settings.evidence_weight > 0:
            score = score + settings.evidence_weight * self._evidence(self.window, side, places)
        return score

    @property
    def pose_score(self) -> float:
        """Score of the detected pose; NaN where nobody was detected."""
        return np.nan if self.detection is None else self.detection.score

    def _evidence(self, window: PersonWindow, side: str, places: F64) -> F64:
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
    """The evidence around a puppet in an image (H, W, 3), with the colours of its torso and head; None outside."""
    window = PersonWindow.around(likelihood, image, puppet.joints, puppet.scale)
    if window is None:
        return None
    torso, head = (puppet.contours[model.tree.names.index(name)] for name in ("torso", "head"))
    return window.with_torso(torso, head)


@dataclass(frozen=True, slots=True, eq=False)
class ArmEvidenceModel:
    """What sees the arms of people: evidence, and the model of ten parts for which it was learned.

    A puppet with hands and feet has these parts and joints too, and before its others.
    """

    model: DeformableStructures
    likelihood: LikelihoodLike

    @classmethod
    def load(cls, name: str) -> Self:
        """Eyes for puppets of a body model, "neutral", "female" or "male"."""
        return cls(DeformableStructures.load(name), PartLikelihood.load())

    def evidence(self, image: U8, puppet: TrackedPuppet, detection: PersonDetection | None) -> ArmEvidence:
        """How a tracked puppet is seen in an image (H, W, 3) or (H, W), where the detector found it so."""
        colour = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image
        # Sums of several BLAS threads would differ in their last bits.
        with one_blas_thread():
            window = person_window(self.model, self.likelihood, colour, puppet)
        joints = puppet.joints[: len(self.model.joint_names)]
        return ArmEvidence(self.model, joints, puppet.scale, puppet.view, detection, window)
