# SPDX-License-Identifier: Apache-2.0
"""Evidence for the pose search: who was detected, and how well parts explain the pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self

import cv2
import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.image.formats.keypoints import Keypoints, normalise_name

KEYPOINT_SD = 0.04
"""Standard deviation, as a share of the shoulder width, with which a keypoint of confidence 1 binds a joint."""

ARM_MARGIN_M = 0.75  # around the known joints: how far arms may reach
MIN_SIDE_PX = 8  # of a window that holds any evidence
MAX_SCALE_PX_PER_M = 130.0  # larger people are scored on a reduced image
MIN_HAND_SCORE = 1e-3  # of a place, relative to the most likely pixel

MAX_KEYPOINT_DEVIATIONS = 3.0
"""Standard deviations beyond which a keypoint counts as wrong, and its score falls no further."""


class ImageEvidenceLike(Protocol):
    """Evidence of one image, see `evidence.image.likelihood`."""

    def log_likelihood(self, part: int, contours: Array, scale: Array) -> Array:
        """Return the log likelihood (P,) of a part with `contours` (P, K, 2) px at `scale` (P,) px/m (Eq. 20)."""
        ...

    def with_torso(self, torso: Array, head: Array) -> Self:
        """Return evidence with the colours inside the contours (K, 2) px of a torso and a head."""
        ...

    def hand_map(self, scale: float) -> Array:
        """Return how likely the pixels (H, W) are hands of a person of `scale` px/m: non-negative, in any unit."""
        ...


class LikelihoodLike(Protocol):
    """A likelihood model that makes the evidence of an image."""

    def prepare(self, image: Array) -> ImageEvidenceLike:
        """Return the evidence of an image (H, W, 3) RGB uint8."""
        ...


class PersonWindow:
    """The evidence around one person: a piece of the image, reduced if larger than the evidence needs."""

    def __init__(self, evidence: ImageEvidenceLike, corner: Array, factor: float) -> None:
        """Take the evidence of a piece, its `corner` (x, y) in the image, and its pixels per pixel of the image."""
        self._evidence, self._corner, self._factor = evidence, corner, factor
        self._hand_map: tuple[float, Array] | None = None

    @classmethod
    def around(cls, likelihood: LikelihoodLike, image: Array, joints: Array, scale: float) -> PersonWindow | None:
        """Cut out what the arms of a person with `joints` (J, 2) px may reach; None when that is outside the image."""
        known = joints[np.isfinite(joints).all(axis=1)]
        size = np.array(image.shape[1::-1])
        low = np.clip(np.floor(known.min(axis=0) - ARM_MARGIN_M * scale), 0, size).astype(int)
        high = np.clip(np.ceil(known.max(axis=0) + ARM_MARGIN_M * scale), 0, size).astype(int)
        if (high - low < MIN_SIDE_PX).any():
            return None
        piece = np.ascontiguousarray(image[low[1] : high[1], low[0] : high[0]])
        factor = min(1.0, MAX_SCALE_PX_PER_M / scale)
        if factor < 1.0:
            width, height = np.maximum(np.rint((high - low) * factor), 1).astype(int)
            piece = cv2.resize(piece, (int(width), int(height)), interpolation=cv2.INTER_AREA)
        return cls(likelihood.prepare(piece), low.astype(float), factor)

    @property
    def evidence(self) -> ImageEvidenceLike:
        """Evidence of the piece, in its own pixels."""
        return self._evidence

    @property
    def corner(self) -> Array:
        """Upper left corner (x, y) of the piece in the image."""
        return self._corner

    @property
    def factor(self) -> float:
        """Pixels of the piece per pixel of the image."""
        return self._factor

    def log_likelihood(self, part: int, contours: Array, scale: Array) -> Array:
        """Return the log likelihood (P,) of a part with `contours` (P, K, 2) px of the image at `scale` (P,) px/m."""
        return self._evidence.log_likelihood(part, self.to_piece(contours), scale * self._factor)

    def with_torso(self, torso: Array, head: Array) -> PersonWindow:
        """Return the window with the colours inside the contours (K, 2) px of a torso and a head."""
        evidence = self._evidence.with_torso(self.to_piece(torso), self.to_piece(head))
        return PersonWindow(evidence, self._corner, self._factor)

    def score_hands(self, places: Array, scale: float) -> Array:
        """Return how likely `places` (K, 2) px of the image are hands, in (0, 1] relative to the most likely pixel."""
        if self._hand_map is None or self._hand_map[0] != scale:
            self._hand_map = scale, self._evidence.hand_map(scale * self._factor)
        hand_map = self._hand_map[1]
        x, y = np.rint(self.to_piece(places)).astype(np.int64).T
        inside = (x >= 0) & (y >= 0) & (x < hand_map.shape[1]) & (y < hand_map.shape[0])
        value = np.where(inside, hand_map[np.where(inside, y, 0), np.where(inside, x, 0)], 0.0)
        return np.asarray(np.clip(value / max(float(hand_map.max(initial=0.0)), 1e-12), MIN_HAND_SCORE, 1.0))

    def to_piece(self, points: Array) -> Array:
        """Convert points (..., 2) px of the image to pixels of the piece."""
        return np.ascontiguousarray((points - self._corner) * self._factor)


class PersonHypotheses(Protocol):
    """One person found by the detector or given by the user's keypoints."""

    @property
    def keypoints(self) -> Keypoints:
        """Best joints."""
        ...

    @property
    def confidence(self) -> float:
        """Probability that this is a person."""
        ...

    @property
    def joints_are_independent(self) -> bool:
        """Whether the score of a joint says nothing about other joints, unlike that of a whole pose."""
        ...

    def modes(self, count: int) -> list[tuple[Keypoints, float]]:
        """Return up to `count` different poses, best first, with their scores relative to the best (0 or less)."""
        ...

    def joint_score(self, joint: str, xy: Array) -> Array:
        """Return the score (K,) of the best pose with a joint at each of `xy` (K, 2) px, relative to the best pose."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class KeypointPerson:
    """A person known by keypoints alone, for example those of `--init`; `shoulder_width` is in pixels."""

    keypoints: Keypoints
    shoulder_width: float

    @property
    def confidence(self) -> float:
        """Mean confidence of the known keypoints."""
        known = [point[2] for point in self.keypoints.select_usable().values()]
        return float(np.mean(known)) if known else 0.0

    @property
    def joints_are_independent(self) -> bool:
        """Each keypoint was found by itself."""
        return True

    def modes(self, count: int) -> list[tuple[Keypoints, float]]:
        """Return the keypoints, the only pose."""
        return [(self.keypoints, 0.0)][:count]

    def joint_score(self, joint: str, xy: Array) -> Array:
        """Return minus half the squared distance to the keypoint, in deviations up to a limit; 0 if it is unknown."""
        for name, place, confidence in zip(
            self.keypoints.names, self.keypoints.xy, self.keypoints.confidence, strict=True
        ):
            if normalise_name(name) == joint and np.isfinite(place).all() and confidence > 0:
                deviation = KEYPOINT_SD * self.shoulder_width / np.sqrt(min(1.0, confidence))
                squared = ((xy - place) ** 2).sum(axis=1) / deviation**2
                return np.asarray(-0.5 * np.minimum(squared, MAX_KEYPOINT_DEVIATIONS**2))
        return np.zeros(len(xy))
