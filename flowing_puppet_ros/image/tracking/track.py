# SPDX-License-Identifier: Apache-2.0
"""State of one tracked person: joints with their uncertainty, scale and view; and fusion of detections into it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64, I64, Bools, Flow
from flowing_puppet_ros.image.person_mask import PersonMask
from flowing_puppet_ros.image.tracking.heading import HeadingFilter
from flowing_puppet_ros.image.tracking.settings import TrackerSettings
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.shape import PuppetShape, View

UNKNOWN_DEVIATION_M = 0.25  # a joint this uncertain is placed by the body model instead
CONFIDENT_DEVIATION_M = 0.1  # confidence halves at this standard deviation
MAX_VIEW_VOTES = 5.0  # the evidence for the view saturates here ...
MIN_TURN_VOTES = 3.0  # ... and must reach this for the other side to flip the puppet
SCALE_GAIN = 0.1  # share of the new scale estimate taken at each detection
MIN_OVERRIDE_M = 0.06  # `Track.override_joint` ignores smaller moves
APPEARANCE_GAIN = 0.2  # share of the newly seen colours taken at each detection
MISSING_SHARE = 0.3  # of a joint's quality that it loses at each detection of its person which does not have it
MAX_MASK_AGE = 8  # images for which the flow alone carries a mask
OPEN_GATE_AGE = 1_000  # images without a detection after which any detected position passes the gate


@dataclass(slots=True, eq=False)
class Track:
    """State of one track; joints in pixels of the image.

    `mean` (J, 2) and isotropic `variance` (J,) px^2 of the joints, `quality` (J,) of the detections behind them.
    `outlier_position` (J, 2) is the last detected position that the gate rejected (NaN none) and `outlier_count` (J,)
    how often in a row it was seen there. `age` (J,) counts the images since a detection was last accepted. `detected`
    (J, 3) is this image's detection as x, y and confidence, `detection` its index among the detections, or None.
    `detector_id` is the detector's own id of the last matched detection that had one.
    `unseen` and `missed` count images and detector runs without a match. `appearance` are the colours of the torso (see
    `appearance`) or None; `overlapped` is set if another torso overlapped with it since the last detection. `heading`
    tells from which side the person is seen, None where only front and back are told apart. `mask` is where the person
    is in the image, as a network has said at most `mask_age` images ago.
    """

    id: str
    mean: F64
    variance: F64
    quality: F64
    outlier_position: F64
    outlier_count: I64
    age: I64
    scale: float
    view: View
    detected: F64 | None = None
    detection: int | None = None
    detector_id: str = ""
    view_votes: float = 0.0
    unseen: int = 0
    missed: int = 0
    flow_energy: float = 0.0
    detection_energy: float = 0.0
    shape: PuppetShape | None = None
    appearance: F64 | None = None
    overlapped: bool = False
    heading: HeadingFilter | None = None
    mask: PersonMask | None = None
    mask_age: int = 0

    @classmethod
    def start(
        cls,
        identity: str,
        model: DeformableStructures,
        joints: F64,
        confidence: F64,
        settings: TrackerSettings,
        heading: HeadingFilter | None = None,
    ) -> Track:
        """Start a track at a detection: `joints` (J, 2) px with NaN where unknown, `confidence` (J,).

        With a `heading` it is drawn by the puppet of the side from which the person is seen.
        """
        scale = model.estimate_scale(joints, confidence)
        view = model.estimate_view(joints, confidence)
        count = len(joints)
        known = np.isfinite(joints).all(axis=1)
        variance = np.full(count, (2 * UNKNOWN_DEVIATION_M * scale) ** 2)
        variance[known] = detection_variance(confidence[known], scale, settings)
        track = cls(
            id=identity,
            mean=joints.copy(),
            variance=variance,
            quality=confidence.copy(),
            outlier_position=np.full((count, 2), np.nan),
            outlier_count=np.zeros(count, dtype=np.int64),
            age=np.zeros(count, dtype=np.int64),
            scale=scale,
            view=view,
            detected=np.column_stack([joints, confidence]),
            view_votes=MIN_TURN_VOTES if view == "front" else -MIN_TURN_VOTES,
            heading=heading,
        )
        if heading is not None:
            heading.update(joints, confidence, view)
        track.complete_and_redraw(model)
        return track

    @property
    def unknown(self) -> Bools:
        """Joints (J,) that are so uncertain that the body model places them."""
        unknown: Bools = ~(np.sqrt(self.variance) < UNKNOWN_DEVIATION_M * self.scale)
        return unknown

    @property
    def confidence(self) -> F64:
        """Confidence (J,) in [0, 1] of visible joints; it falls with their variance."""
        spread = self.variance / (CONFIDENT_DEVIATION_M * self.scale) ** 2
        confidence: F64 = np.clip(self.quality / (1 + spread), 0, 1)
        return confidence

    def find_outside(self, image_size: tuple[int, int]) -> Bools:
        """Return which joints (J,) lie outside of the image (width, height)."""
        return ((self.mean < -0.5) | (self.mean > np.array(image_size) - 0.5)).any(axis=1)

    @property
    def side_heading(self) -> float:
        """Angle in rad by which the drawn puppet is turned to the right, 0 for front and back."""
        return 0.0 if self.heading is None else self.heading.side_heading

    def choose_model(self, model: DeformableStructures) -> DeformableStructures:
        """Return the puppet of the side from which the person is seen, `model` from front and back."""
        side = None if self.heading is None else self.heading.side_model
        return model if side is None else side

    def complete_and_redraw(self, model: DeformableStructures) -> None:
        """Place the unknown joints by the body model and draw the puppet for the joints, scale and view."""
        unknown, model = self.unknown, self.choose_model(model)
        weight = np.where(unknown, 0.0, np.maximum(self.quality, 0.05))
        if unknown.any():
            known = np.where(unknown[:, None], np.nan, self.mean)
            self.mean = np.asarray(model.complete_joints(known, weight, self.scale, self.view), dtype=np.float64)
        self.shape = model.puppet_from_joints(self.mean, self.scale, self.view)

    def update_scale_and_view(self, model: DeformableStructures) -> None:
        """Follow the scale slowly, and flip between front and back only on repeated evidence."""
        joints = np.where(self.unknown[:, None], np.nan, self.mean)
        confidence = np.where(self.unknown, 0.0, self.quality)
        scale = self.choose_model(model).estimate_scale(joints, confidence)
        self.scale *= float(np.clip(scale / self.scale, 0.5, 2.0)) ** SCALE_GAIN
        vote = 1.0 if model.estimate_view(joints, confidence) == "front" else -1.0
        self.view_votes = float(np.clip(self.view_votes + vote, -MAX_VIEW_VOTES, MAX_VIEW_VOTES))
        if self.view_votes >= MIN_TURN_VOTES:
            self.view = "front"
        elif self.view_votes <= -MIN_TURN_VOTES:
            self.view = "back"
        if self.heading is not None:
            self.heading.update(joints, confidence, self.view)

    def override_joint(self, joint: int, place: F64, confidence: float, settings: TrackerSettings) -> None:
        """Move a joint to a known position `place` (2,) px unless it is close; a NaN `confidence` keeps the old one."""
        if np.isfinite(confidence):
            self.quality[joint] = confidence
        if float(np.hypot(*(place - self.mean[joint]))) <= MIN_OVERRIDE_M * self.scale:
            return
        self.mean[joint] = place
        self.variance[joint] = float(detection_variance(self.quality[joint], self.scale, settings))
        self.age[joint] = self.outlier_count[joint] = 0
        self.outlier_position[joint] = np.nan

    def carry_mask(self, forward: Flow, image_size: tuple[int, int]) -> None:
        """Move the mask along the flow from the image before, or drop it when it is old.

        `forward` (h, w, 2) is in pixels of its own grid, and `image_size` (width, height).
        """
        self.mask_age += 1
        if self.mask is not None:
            self.mask = None if self.mask_age > MAX_MASK_AGE else self.mask.carry(forward, image_size)

    def update_appearance(self, colours: F64) -> None:
        """Follow the colours of the torso slowly."""
        seen = (
            colours if self.appearance is None else (1 - APPEARANCE_GAIN) * self.appearance + APPEARANCE_GAIN * colours
        )
        self.appearance = np.asarray(seen)

    def reset_gate(self) -> None:
        """Accept the next detection however far away it is."""
        self.age[:] = OPEN_GATE_AGE

    def fuse(self, joints: F64, confidence: F64, settings: TrackerSettings) -> None:
        """Fuse detected `joints` (J, 2) px, NaN unknown, and their `confidence` (J,) by precision-weighted means.

        Case of a joint, by its distance in standard deviations from the propagated one:

        - within `gate`: fused;
        - farther: an outlier, ignored at first. The joint jumps there once `outliers_to_accept` outliers in a row
          agree, or once `gate` times the images since the last accepted detection has reached it: flow errs in
          proportion to the motion, again and again in one direction, so the gate opens while flow alone propagates.
        - not in the detection: the flow alone propagates it, and it is less sure. Limbs of which a detector is not sure
          are mostly hidden, and the flow there is that of what hides them.

        Sets `detection_energy`, half the squared distances in standard deviations, of outliers the gate's.
        """
        self.detected = np.column_stack([joints, confidence])
        seen = np.isfinite(joints).all(axis=1) & (confidence > 0)
        noise = detection_variance(np.where(seen, confidence, 1.0), self.scale, settings)
        total = self.variance + noise
        distance = np.where(seen, _squared_norms(joints - self.mean) / total, 0.0)
        outlier = seen & (distance > settings.gate**2)
        again = outlier & (_squared_norms(joints - self.outlier_position) <= settings.gate**2 * total)
        self.outlier_count = np.where(
            seen, np.where(again, self.outlier_count + 1, outlier.astype(np.int64)), self.outlier_count
        )
        self.outlier_position[seen] = np.where(outlier[:, None], joints, np.nan)[seen]
        jump = outlier & (
            (self.outlier_count >= settings.outliers_to_accept) | (distance <= (settings.gate * self.age) ** 2)
        )
        good = seen & ~outlier
        gain = np.where(jump, 1.0, np.where(good, self.variance / total, 0.0))
        self.mean = self.mean + gain[:, None] * np.where(seen[:, None], joints - self.mean, 0.0)
        self.variance = np.where(jump, noise, (1 - gain) * self.variance)
        quality = self.quality + gain * (confidence - self.quality)
        self.quality = np.where(seen, quality, (1 - MISSING_SHARE) * self.quality)
        self.age[good | jump] = 0
        self.outlier_count[jump] = 0
        self.outlier_position[jump] = np.nan
        self.detection_energy = 0.5 * float(distance[good].sum() + settings.gate**2 * np.count_nonzero(outlier))


def detection_variance(confidence: F64, scale: float, settings: TrackerSettings) -> F64:
    """Return the variance (J,) px^2 of detected joints of this `confidence` (J,) on a person of `scale` px/m."""
    variance: F64 = (settings.detection_deviation * scale) ** 2 / np.clip(confidence, 0.05, 1.0)
    return variance


def _squared_norms(vectors: F64) -> F64:
    squares: F64 = np.einsum("ni,ni->n", vectors, vectors)
    return squares
