# SPDX-License-Identifier: Apache-2.0
"""One tracked person: joints with their uncertainty, scale and view; and how detections are fused into them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64, I64, Bools
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.shape import PuppetShape, View
from flowing_puppet_ros.settings import Settings, setting

UNKNOWN_DEVIATION = 0.25  # m; a joint this uncertain is placed by the body model instead
CONFIDENT_DEVIATION = 0.1  # m; confidence halves at this standard deviation
VIEW_VOTES = 5.0  # the view's evidence saturates here ...
VIEW_TURNS = 3.0  # ... and must reach this on the other side to turn the puppet round
SCALE_GAIN = 0.1  # share of the new scale estimate taken at each detection
ELSEWHERE = 0.06  # m; a joint that is known to be farther off than this is moved at once
APPEARANCE_GAIN = 0.2  # share of the newly seen colours taken at each detection
LONG_AGO = 1_000  # images; a joint that was not detected for so long goes to where it is


@dataclass(frozen=True)
class TrackerSettings(Settings):
    """How people are carried, re-anchored, started and dropped."""

    detection_deviation: float = setting(
        0.015, "standard deviation of a certain detection's joint", unit="m", low=0.001, high=0.5
    )
    flow_deviation: float = setting(
        0.007, "drift of a joint carried by flow, each image", unit="m", low=0.0005, high=0.5
    )
    gate: float = setting(3.5, "deviations beyond which a detected joint is doubted", low=1.0, high=100.0)
    patience: int = setting(3, "detections in agreement that outvote the gate", low=1, high=100)
    match_distance: float = setting(0.5, "largest median joint distance to match", unit="m", low=0.01, high=10.0)
    least_joints: int = setting(5, "known joints that a detection needs to start a person", low=3, high=15)
    most_people: int = setting(8, "people tracked at once", low=1, high=100)
    unseen_images: int = setting(300, "images without a match after which a person is dropped", low=1, high=100000)
    missed_detections: int = setting(
        15, "detector runs without a match after which a person is dropped", low=1, high=100000
    )
    seed: int = setting(0, "picks the letters that ids begin with", low=0, high=1_000_000)


@dataclass(slots=True, eq=False)
class Track:
    """State of one track; joints in pixels of the image.

    `mean` (J, 2), isotropic `variance` (J,) px^2, `quality` (J,) of the detections behind each joint, `doubted`
    (J, 2) last detected place that the gate refused (NaN none), `doubts` (J,) how often in a row it stood there,
    `age` (J,) how many images ago a detection was last taken, `detected` (J, 3) this image's detection as x, y and
    confidence, or None, and `detection` its index among the detections, `clothes` the colours of the torso (see
    `appearance`) or None, `met` whether somebody else's torso overlapped with it since the last detection.
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
    votes: float = 0.0
    unseen: int = 0
    missed: int = 0
    flow_energy: float = 0.0
    detection_energy: float = 0.0
    shape: PuppetShape | None = None
    appearance: F64 | None = None
    overlapped: bool = False

    @classmethod
    def start(
        cls, identity: str, model: DeformableStructures, joints: F64, confidence: F64, settings: TrackerSettings
    ) -> Track:
        """Begin a track at a detection: `joints` (J, 2) px with NaN where unknown, `confidence` (J,)."""
        scale = model.estimate_scale(joints, confidence)
        view = model.estimate_view(joints, confidence)
        count = len(joints)
        known = np.isfinite(joints).all(axis=1)
        variance = np.full(count, (2 * UNKNOWN_DEVIATION * scale) ** 2)
        variance[known] = detection_variance(confidence[known], scale, settings)
        votes = VIEW_TURNS if view == "front" else -VIEW_TURNS
        nowhere = np.full((count, 2), np.nan)
        doubts, age = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
        detected = np.column_stack([joints, confidence])
        state = identity, joints.copy(), variance, confidence.copy(), nowhere, doubts, age, scale, view
        person = cls(*state, detected=detected, votes=votes)
        person.complete_and_redraw(model)
        return person

    @property
    def unknown(self) -> Bools:
        """(J,) whether a joint is so uncertain that the body model places it."""
        unknown: Bools = ~(np.sqrt(self.variance) < UNKNOWN_DEVIATION * self.scale)
        return unknown

    @property
    def confidence(self) -> F64:
        """(J,) in [0, 1], of joints that can be seen: falls with the joint's variance."""
        spread = self.variance / (CONFIDENT_DEVIATION * self.scale) ** 2
        confidence: F64 = np.clip(self.quality / (1 + spread), 0, 1)
        return confidence

    def outside(self, image_size: tuple[int, int]) -> Bools:
        """(J,) whether a joint lies outside of the image (width, height)."""
        return ((self.mean < -0.5) | (self.mean > np.array(image_size) - 0.5)).any(axis=1)

    def complete_and_redraw(self, model: DeformableStructures) -> None:
        """Place the unknown joints by the body model and draw the puppet for the joints, scale and view."""
        unknown = self.unknown
        weight = np.where(unknown, 0.0, np.maximum(self.quality, 0.05))
        if unknown.any():
            known = np.where(unknown[:, None], np.nan, self.mean)
            self.mean = np.asarray(model.complete_joints(known, weight, self.scale, self.view), dtype=np.float64)
        self.shape = model.puppet_from_joints(self.mean, self.scale, self.view)

    def update_scale_and_view(self, model: DeformableStructures) -> None:
        """Follow the scale slowly, and turn between front and back only on repeated evidence."""
        joints = np.where(self.unknown[:, None], np.nan, self.mean)
        confidence = np.where(self.unknown, 0.0, self.quality)
        scale = model.estimate_scale(joints, confidence)
        self.scale *= float(np.clip(scale / self.scale, 0.5, 2.0)) ** SCALE_GAIN
        vote = 1.0 if model.estimate_view(joints, confidence) == "front" else -1.0
        self.votes = float(np.clip(self.votes + vote, -VIEW_VOTES, VIEW_VOTES))
        if self.votes >= VIEW_TURNS:
            self.view = "front"
        elif self.votes <= -VIEW_TURNS:
            self.view = "back"

    def override_joint(self, joint: int, place: F64, confidence: float, settings: TrackerSettings) -> None:
        """Move a joint to where it is known to be, (2,) px, unless it is about there; NaN: as sure as before."""
        if np.isfinite(confidence):
            self.quality[joint] = confidence
        if float(np.hypot(*(place - self.mean[joint]))) <= ELSEWHERE * self.scale:
            return
        self.mean[joint] = place
        self.variance[joint] = float(detection_variance(self.quality[joint], self.scale, settings))
        self.age[joint] = self.outlier_count[joint] = 0
        self.outlier_position[joint] = np.nan

    def update_appearance(self, colours: F64) -> None:
        """Follow the colours of the torso slowly."""
        seen = (
            colours if self.appearance is None else (1 - APPEARANCE_GAIN) * self.appearance + APPEARANCE_GAIN * colours
        )
        self.appearance = np.asarray(seen)

    def reset_gate(self) -> None:
        """Let the next detection, far away, be believed at once."""
        self.age[:] = LONG_AGO

    def fuse(self, joints: F64, confidence: F64, settings: TrackerSettings) -> None:
        """Fuse detected joints (J, 2), NaN unknown: precision-weighted means, behind a gate with patience.

        A detected joint farther than `gate` deviations from the carried one is left out, until `patience` detections
        in a row agree with each other, or the gate, which opens with every image that flow alone carries the joint
        (flow errs in proportion to the motion, again and again in one direction), has reached it: then the joint jumps
        there. Sets `detection_energy`, half the squared
        distance in deviations summed over the joints that were fused.
        """
        self.detected = np.column_stack([joints, confidence])
        seen = np.isfinite(joints).all(axis=1) & (confidence > 0)
        noise = detection_variance(np.where(seen, confidence, 1.0), self.scale, settings)
        total = self.variance + noise
        distance = np.where(seen, _squared(joints - self.mean) / total, 0.0)
        doubtful = seen & (distance > settings.gate**2)
        again = doubtful & (_squared(joints - self.outlier_position) <= settings.gate**2 * total)
        self.outlier_count = np.where(
            seen, np.where(again, self.outlier_count + 1, doubtful.astype(np.int64)), self.outlier_count
        )
        self.outlier_position[seen] = np.where(doubtful[:, None], joints, np.nan)[seen]
        jump = doubtful & ((self.outlier_count >= settings.patience) | (distance <= (settings.gate * self.age) ** 2))
        good = seen & ~doubtful
        gain = np.where(jump, 1.0, np.where(good, self.variance / total, 0.0))
        self.mean = self.mean + gain[:, None] * np.where(seen[:, None], joints - self.mean, 0.0)
        self.variance = np.where(jump, noise, (1 - gain) * self.variance)
        self.quality = self.quality + gain * (confidence - self.quality)
        self.age[good | jump] = 0
        self.outlier_count[jump] = 0
        self.outlier_position[jump] = np.nan
        self.detection_energy = 0.5 * float(distance[good].sum() + settings.gate**2 * np.count_nonzero(doubtful))


def detection_variance(confidence: F64, scale: float, settings: TrackerSettings) -> F64:
    """Variance in px^2 of detected joints of given `confidence` (J,) on a person of `scale` px/m."""
    variance: F64 = (settings.detection_deviation * scale) ** 2 / np.clip(confidence, 0.05, 1.0)
    return variance


def _squared(vectors: F64) -> F64:
    squares: F64 = np.einsum("ni,ni->n", vectors, vectors)
    return squares
