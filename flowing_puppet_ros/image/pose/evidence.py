# SPDX-License-Identifier: Apache-2.0
"""What the pose search needs to know of an image: who was found, and how well parts explain the pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self

import cv2
import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.image.formats.keypoints import Keypoints, normalise_name

CERTAIN_KEYPOINT = 0.04
"""Deviation in shares of a person's shoulder width with which a keypoint of confidence 1 binds a joint."""

MARGIN = 0.75  # metres around the known joints that arms may reach
LEAST_SIDE = 8  # pixels of an image in which anything can be told
FINEST = 130.0  # px/m: people who appear larger are judged on a smaller image
LEAST_HAND = 1e-3

DOUBT = 3.0
"""Deviations beyond which a keypoint is held for wrong: its score falls no further."""


class ImageEvidenceLike(Protocol):
    """The evidence of one image, see `evidence.image.likelihood`."""

    def log_likelihood(self, part: int, contours: Array, scale: Array) -> Array:
        """Log likelihood (P,) of a part with contours (P,K,2) px at scale (P,) px/m (Eq. 20)."""
        ...

    def with_torso(self, torso: Array, head: Array) -> Self:
        """The evidence that also knows the colours inside the contours (K,2) px of a torso and a head."""
        ...

    def hand_map(self, scale: float) -> Array:
        """How likely the pixels (H,W) are hands of a person of `scale` px/m: non-negative, in any unit."""
        ...


class LikelihoodLike(Protocol):
    """What makes the evidence of an image."""

    def scene(self, image: Array) -> ImageEvidenceLike:
        """The evidence of an image (H,W,3) RGB uint8."""
        ...


class PersonWindow:
    """The evidence around one person: a piece of the image, shrunk where it is larger than the evidence needs."""

    def __init__(self, scene: ImageEvidenceLike, corner: Array, factor: float) -> None:
        """`corner` (x, y) of the piece in the image and its pixels per pixel of the image."""
        self._scene, self._corner, self._factor = scene, corner, factor
        self._hands: tuple[float, Array] | None = None

    @classmethod
    def around(cls, likelihood: LikelihoodLike, image: Array, joints: Array, scale: float) -> PersonWindow | None:
        """The piece of an image that the arms of a person with these joints (J,2) reach; None when it is outside."""
        known = joints[np.isfinite(joints).all(axis=1)]
        size = np.array(image.shape[1::-1])
        low = np.clip(np.floor(known.min(axis=0) - MARGIN * scale), 0, size).astype(int)
        high = np.clip(np.ceil(known.max(axis=0) + MARGIN * scale), 0, size).astype(int)
        if (high - low < LEAST_SIDE).any():
            return None
        piece = np.ascontiguousarray(image[low[1] : high[1], low[0] : high[0]])
        factor = min(1.0, FINEST / scale)
        if factor < 1.0:
            width, height = np.maximum(np.rint((high - low) * factor), 1).astype(int)
            piece = cv2.resize(piece, (int(width), int(height)), interpolation=cv2.INTER_AREA)
        return cls(likelihood.scene(piece), low.astype(float), factor)

    @property
    def scene(self) -> ImageEvidenceLike:
        """The evidence of the piece, in its own pixels."""
        return self._scene

    @property
    def corner(self) -> Array:
        """Where (x, y) in the image the piece begins."""
        return self._corner

    @property
    def factor(self) -> float:
        """Pixels of the piece per pixel of the image."""
        return self._factor

    def log_likelihood(self, part: int, contours: Array, scale: Array) -> Array:
        """Log likelihood (P,) of a part with contours (P,K,2) in pixels of the image at scale (P,) px/m."""
        return self._scene.log_likelihood(part, self.inside(contours), scale * self._factor)

    def with_torso(self, torso: Array, head: Array) -> PersonWindow:
        """The window that also knows the colours inside the contours (K,2) of a torso and a head."""
        scene = self._scene.with_torso(self.inside(torso), self.inside(head))
        return PersonWindow(scene, self._corner, self._factor)

    def hands(self, places: Array, scale: float) -> Array:
        """How likely places (K,2) in pixels of the image are hands, in (0, 1] relative to the most likely pixel."""
        if self._hands is None or self._hands[0] != scale:
            self._hands = scale, self._scene.hand_map(scale * self._factor)
        likely = self._hands[1]
        x, y = np.rint(self.inside(places)).astype(np.int64).T
        seen = (x >= 0) & (y >= 0) & (x < likely.shape[1]) & (y < likely.shape[0])
        value = np.where(seen, likely[np.where(seen, y, 0), np.where(seen, x, 0)], 0.0)
        return np.asarray(np.clip(value / max(float(likely.max(initial=0.0)), 1e-12), LEAST_HAND, 1.0))

    def inside(self, points: Array) -> Array:
        """Points (...,2) of the image in pixels of the piece."""
        return np.ascontiguousarray((points - self._corner) * self._factor)


class PersonHypotheses(Protocol):
    """One person whom the detector, or the user's keypoints, found."""

    @property
    def keypoints(self) -> Keypoints:
        """The best joints."""
        ...

    @property
    def confidence(self) -> float:
        """Probability that this is a person."""
        ...

    def modes(self, count: int) -> list[tuple[Keypoints, float]]:
        """Up to `count` different poses, best first, with their scores relative to the best (0 or less)."""
        ...

    def joint_score(self, joint: str, xy: Array) -> Array:
        """Score (K,) of the best pose that has a joint at each of the places xy (K,2), relative to the best pose."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class KeypointPerson:
    """A person known by keypoints alone, for example those of `--init`; `width` is a shoulder width in pixels."""

    keypoints: Keypoints
    width: float

    @property
    def confidence(self) -> float:
        """Mean confidence of the keypoints that are known."""
        known = [point[2] for point in self.keypoints.usable().values()]
        return float(np.mean(known)) if known else 0.0

    def modes(self, count: int) -> list[tuple[Keypoints, float]]:
        """The keypoints; there is nothing else."""
        return [(self.keypoints, 0.0)][:count]

    def joint_score(self, joint: str, xy: Array) -> Array:
        """Minus half the squared distance to the keypoint, in deviations and up to a limit; 0 where it is unknown."""
        for name, place, confidence in zip(
            self.keypoints.names, self.keypoints.xy, self.keypoints.confidence, strict=True
        ):
            if normalise_name(name) == joint and np.isfinite(place).all() and confidence > 0:
                deviation = CERTAIN_KEYPOINT * self.width / np.sqrt(min(1.0, confidence))
                squared = ((xy - place) ** 2).sum(axis=1) / deviation**2
                return np.asarray(-0.5 * np.minimum(squared, DOUBT**2))
        return np.zeros(len(xy))
