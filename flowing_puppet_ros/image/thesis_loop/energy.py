# SPDX-License-Identifier: Apache-2.0
"""The energy of flowing puppets (Eqs. 33-35), for many puppets of one image at once.

It consists of prior, contour, colour and hands in the image, the same evidence in the neighbouring images at the puppet
propagated by the flow, and the detector's score, without which the search leaves good arms for edges and skin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.evidence.image.hands import HandMaps, hand_score
from flowing_puppet_ros.evidence.image.likelihood import ImageEvidence
from flowing_puppet_ros.image.pose.evidence import PersonHypotheses, PersonWindow
from flowing_puppet_ros.image.thesis_loop.flow_moments import FlowMoments
from flowing_puppet_ros.image.thesis_loop.settings import EnergySettings
from flowing_puppet_ros.image.thesis_loop.upper_body import UpperBodyParameters
from flowing_puppet_ros.image.tracking.propagation import part_membership

TERMS = ("contour", "colour", "hands", "detector")
SCORED_JOINTS = tuple(f"{side}_{name}" for name in ("shoulder", "elbow", "wrist") for side in ("right", "left"))


@dataclass(slots=True, eq=False)
class FrameEvidence:
    """Evidence for puppets of one person in one image.

    `window` are the pixels around the person, `hands` the hand maps, `found` is the detection or the given keypoints,
    `before` and `after` are the flow to the neighbouring images; each is None if there is none.
    """

    window: PersonWindow | None
    hands: HandMaps | None
    found: PersonHypotheses | None
    before: FlowMoments | None = None
    after: FlowMoments | None = None

    def terms(self, body: UpperBodyParameters, joints: F64, scale: F64, contours: Sequence[F64]) -> F64:
        """Return log likelihoods (P, 4) of TERMS (Eq. 34); `joints` (P, J, 2) px, `contours` (P, K_i, 2) px by part."""
        terms = np.zeros((len(joints), len(TERMS)))
        evidence = None if self.window is None else self.window.evidence
        if self.window is not None and isinstance(evidence, ImageEvidence):
            size = scale * self.window.factor
            for part in body.parts:
                contour, colour = evidence.contour_and_colour(part, self.window.to_piece(contours[part]), size)
                terms[:, 0] += contour
                terms[:, 1] += colour
        names = body.model.joint_names
        if self.hands is not None:
            for side in ("right", "left"):
                wrist, elbow = (joints[:, names.index(f"{side}_{name}")] for name in ("wrist", "elbow"))
                terms[:, 2] += hand_score(self.hands, wrist, elbow, float(np.median(scale)))
        if self.found is not None:
            for name in SCORED_JOINTS:
                terms[:, 3] += self.found.joint_score(name, joints[:, names.index(name)])
        return terms


def propagate_joints(body: UpperBodyParameters, flow: FlowMoments, joints: F64, contours: Sequence[F64]) -> F64:
    """Move `joints` (P, J, 2) px by the flow: the flowing puppets of thesis section 2.

    Eq. 33's motion term, which has no noise. A joint moves by the mean of its parts' motions, weighted by their pixels.
    """
    motions, weights = zip(*(flow.fit_affine(contours[part]) for part in body.parts), strict=True)
    member = part_membership(body.model)[list(body.parts)]
    moved = np.stack([joints @ np.swapaxes(m[:, :, :2], 1, 2) + m[:, None, :, 2] for m in motions])
    share = (np.stack(weights)[:, :, None] + 1e-6) * member[:, None, :]
    total = share.sum(axis=0)
    mean = (share[..., None] * moved).sum(axis=0) / np.maximum(total, 1e-12)[..., None]
    # Legs are not part of the search: they move with the torso.
    return np.where((total > 0)[..., None], mean, moved[0])


class FlowingEnergy:
    """Energy (Eq. 35), the negative logarithm of Eq. 33, in the images of a clip; `frames` are those of one person."""

    def __init__(self, body: UpperBodyParameters, frames: Sequence[FrameEvidence], settings: EnergySettings) -> None:
        """Take the frames; their flow must lead from each to the next."""
        self.body, self.frames, self.settings = body, frames, settings

    def evaluate(self, frame: int, vectors: F64, legs: F64) -> F64:
        """Return the energies (P,) of Eq. 35 of `vectors` (P, D) in one frame; `legs` (J, 2) as of `leg_offsets`."""
        joints, scale = self.body.to_joints(vectors, legs)
        prior, own, elsewhere = self.terms(frame, joints, scale)
        weights = self.settings.weights
        return np.asarray(self.settings.prior_weight * prior - (own + elsewhere) @ weights, dtype=np.float64)

    def terms(self, frame: int, joints: F64, scale: F64) -> tuple[F64, F64, F64]:
        """Return the prior energy (P,), the evidence (P, 4) in the frame, and its sum (P, 4) in the neighbours."""
        contours, prior = self.body.model.puppets_from_joints(joints, scale, self.body.view, self.body.edges)
        own = self.frames[frame].terms(self.body, joints, scale, contours)
        elsewhere = np.zeros_like(own)
        for step, wanted in ((1, self.settings.forward_flow), (-1, self.settings.backward_flow)):
            if wanted:
                elsewhere += self._propagated_terms(frame, step, joints, scale, contours)
        return prior, own, elsewhere

    def _propagated_terms(self, frame: int, step: int, joints: F64, scale: F64, contours: Sequence[F64]) -> F64:
        terms = np.zeros((len(joints), len(TERMS)))
        for _ in range(self.settings.flow_steps):
            flow = self.flow_to_neighbour(frame, step)
            if flow is None:
                break
            joints = propagate_joints(self.body, flow, joints, contours)
            contours, _ = self.body.model.puppets_from_joints(joints, scale, self.body.view, [])
            frame += step
            terms += self.frames[frame].terms(self.body, joints, scale, contours)
        return terms

    def flow_to_neighbour(self, frame: int, step: int) -> FlowMoments | None:
        """Return the flow from a frame to its neighbour; None at the clip's ends and where it is unknown."""
        if not 0 <= frame + step < len(self.frames):
            return None
        return self.frames[frame].after if step > 0 else self.frames[frame].before
