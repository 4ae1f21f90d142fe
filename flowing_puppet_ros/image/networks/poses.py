# SPDX-License-Identifier: Apache-2.0
"""Joints as a network gives them, and the geometry that all networks share: canvases, crops and duplicates."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64, I64, Image
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.skeletons import COCO_17

OTHER_SIDE: I64 = np.array([0, *(row + (1 if row % 2 else -1) for row in range(1, len(COCO_17)))])
"""For each joint the one of the other side."""
SHOULDERS, HIPS = (5, 6), (11, 12)
STRIDE = 32  # the sides of a network's input are multiples of it
MIN_REACH_SCORE = 0.2  # of a joint that a square around a person has to contain
MAX_SAME_DISTANCE = 0.5  # median distance of joints, in shoulder widths, within which two poses are one person's
MIN_SHOULDER_SHARE = (
    0.45  # of the trunk, that a person's shoulder width has at least: from the side it is foreshortened
)


@dataclass(frozen=True, slots=True, eq=False)
class NetworkPose:
    """One person: `joints` (17, 2) px in the order of COCO_17, raw `scores` (17,), and `score` of the person."""

    joints: F64
    scores: F64
    score: float

    @property
    def trunk(self) -> float:
        """Distance px from the middle of the shoulders to that of the hips."""
        return float(np.hypot(*(self.joints[list(SHOULDERS)].mean(axis=0) - self.joints[list(HIPS)].mean(axis=0))))

    @property
    def size(self) -> float:
        """Shoulder width px, from the side what it would be from the front."""
        shoulders = float(np.hypot(*(self.joints[SHOULDERS[0]] - self.joints[SHOULDERS[1]])))
        return max(shoulders, MIN_SHOULDER_SHARE * self.trunk, 1e-3)

    def mirror(self, width: int) -> NetworkPose:
        """Return the pose in the mirror image of an image of this width px: left is right there."""
        return NetworkPose((width - 1, 0) + self.joints[OTHER_SIDE] * (-1, 1), self.scores[OTHER_SIDE], self.score)

    def exchange_sides(self) -> NetworkPose:
        """Return the pose with left called right."""
        return NetworkPose(self.joints[OTHER_SIDE], self.scores[OTHER_SIDE], self.score)


@dataclass(frozen=True, slots=True, eq=False)
class Warp:
    """Where pixels of a network's input are in the image: `matrix` (2, 3) leads from the input to the image."""

    matrix: F64

    def to_image(self, points: F64) -> F64:
        """Convert points (..., 2) px of the input to the image."""
        return np.asarray(points @ self.matrix[:, :2].T + self.matrix[:, 2])


def fit_to_canvas(image: Image, side: int) -> tuple[Image, Warp]:
    """Return an image (H, W, 3) with its longer side reduced to `side` px, padded to multiples of STRIDE by black."""
    height, width = image.shape[:2]
    factor = side / max(height, width)
    size = max(1, round(width * factor)), max(1, round(height * factor))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR)
    below, right = (-size[1]) % STRIDE, (-size[0]) % STRIDE
    canvas = cv2.copyMakeBorder(small, 0, below, 0, right, cv2.BORDER_CONSTANT)
    across, down = width / size[0], height / size[1]
    return np.asarray(canvas), Warp(np.array([[across, 0, 0.5 * across - 0.5], [0, down, 0.5 * down - 0.5]]))


def cut_square(image: Image, center: F64, half: float, side: int, angle: float = 0.0) -> tuple[Image, Warp]:
    """Return a square of an image as (side, side, 3), black outside of it.

    Args:
        image: (H, W, 3).
        center: (2,) px.
        half: half of the square's side px in the image.
        side: of the result.
        angle: by which the square is turned clockwise, radians.
    """
    step = 2 * half / side
    across = step * np.array([np.cos(angle), np.sin(angle)])
    down = step * np.array([-np.sin(angle), np.cos(angle)])
    corner = center - (across + down) * (side - 1) / 2
    matrix = np.column_stack([across, down, corner])
    # A person who is larger than the square is reduced first: a warp alone would skip pixels.
    shrink = int(step)
    source, towards = image, matrix
    if shrink > 1:
        source, origin = _reduce_around(image, matrix, side, shrink)
        towards = matrix / shrink
        towards[:, 2] = (matrix[:, 2] - origin + 0.5) / shrink - 0.5
    square = cv2.warpAffine(
        source, towards, (side, side), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_CONSTANT
    )
    return np.asarray(square), Warp(matrix)


def _reduce_around(image: Image, matrix: F64, side: int, shrink: int) -> tuple[Image, F64]:
    """Return what a square shows of an image, reduced by a whole number, and the corner (2,) px of that piece."""
    corners = np.array([[0, 0], [side, 0], [0, side], [side, side]]) @ matrix[:, :2].T + matrix[:, 2]
    size = np.array(image.shape[1::-1])
    low = np.clip(np.floor(corners.min(axis=0)) - shrink, 0, size).astype(int)
    count = (np.clip(np.ceil(corners.max(axis=0)) + shrink, 0, size).astype(int) - low) // shrink
    if count.min() <= 0:
        return image[:1, :1] * 0, low.astype(np.float64)
    high = low + count * shrink
    piece = image[low[1] : high[1], low[0] : high[0]]
    reduced = cv2.resize(piece, (int(count[0]), int(count[1])), interpolation=cv2.INTER_AREA)
    return np.asarray(reduced), low.astype(np.float64)


def fit_to_rectangle(image: Image, size: tuple[int, int]) -> tuple[Image, Warp]:
    """Return an image (H, W, 3) reduced into a rectangle of `size` (width, height), with black bars beside it."""
    height, width = image.shape[:2]
    return cut_rectangle(image, np.array([(width - 1) / 2, (height - 1) / 2]), np.array([width, height]), size)


def cut_rectangle(image: Image, center: F64, box: F64, size: tuple[int, int]) -> tuple[Image, Warp]:
    """Return a `box` (width, height) px of an image about `center` (2,), widened to the shape of `size`."""
    step = float(max(box[0] / size[0], box[1] / size[1], 1e-3))
    side = max(size)
    square, warp = cut_square(image, center, step * side / 2, side)
    left, top = (side - size[0]) // 2, (side - size[1]) // 2
    moved = Warp(np.column_stack([warp.matrix[:, :2], warp.to_image(np.array([left, top], float))]))
    return np.ascontiguousarray(square[top : top + size[1], left : left + size[0]]), moved


def pose_distance(one: NetworkPose, other: NetworkPose) -> float:
    """Return the median distance of the joints known to both poses, in units of the larger shoulder width."""
    away = np.hypot(*(one.joints - other.joints).T)
    return float(np.nanmedian(away)) / max(one.size, other.size)


def find_square(pose: NetworkPose, trunk_reach: float, joint_reach: float, min_half: float) -> tuple[F64, float]:
    """Return the centre (2,) px and half the side px of a square about a person's hips.

    Half the side is so many lengths of the trunk, or distances of the farthest joint that is seen, or at least
    `min_half` px.
    """
    center = pose.joints[list(HIPS)].mean(axis=0)
    away = np.hypot(*(pose.joints - center).T)
    farthest = float(away[pose.scores > MIN_REACH_SCORE].max(initial=0.0))
    return center, max(trunk_reach * pose.trunk, joint_reach * farthest, min_half)


def drop_repeated[Item](items: Iterable[Item], pose_of: Callable[[Item], NetworkPose]) -> list[Item]:
    """Return the items, in their order, without those whose pose is that of a person who is there already."""
    kept: list[Item] = []
    for item in items:
        if all(pose_distance(pose_of(item), pose_of(other)) >= MAX_SAME_DISTANCE for other in kept):
            kept.append(item)
    return kept


def drop_duplicates(poses: Sequence[NetworkPose]) -> list[NetworkPose]:
    """Return the poses, most certain first, without those of a person who is there already."""
    return drop_repeated(sorted(poses, key=lambda pose: -pose.score), lambda pose: pose)


def as_pose(person: Keypoints) -> NetworkPose | None:
    """Return the joints that a person shares with COCO_17, NaN where unknown; None without shoulders and hips."""
    joints, scores = np.full((len(COCO_17), 2), np.nan), np.zeros(len(COCO_17))
    for name, (x, y, confidence) in person.select_usable().items():
        if name in COCO_17:
            joints[COCO_17.index(name)], scores[COCO_17.index(name)] = (x, y), confidence
    known = np.isfinite(joints).all(axis=1)
    return NetworkPose(joints, scores, 1.0) if known[[*SHOULDERS, *HIPS]].all() else None
