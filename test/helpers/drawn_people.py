# SPDX-License-Identifier: Apache-2.0
"""People drawn with capsules that move in known ways, and a body model of capsules to track them with.

The model has the interface of the Deformable Structures model, so the tracker is tested on its own.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.tracking.settings import TrackerSettings
from flowing_puppet_ros.image.tracking.tracker import FlowingPuppetTracker, TrackResult
from flowing_puppet_ros.model.ds.shape import PuppetShape, View
from flowing_puppet_ros.model.tree import DS10_PARENTS, PartTree

type Floats = NDArray[np.float64]

MEAN = {
    "neck": (0.0, -0.50),
    "belly": (0.0, -0.12),
    "face": (0.0, -0.68),
    "right_shoulder": (-0.18, -0.46),
    "left_shoulder": (0.18, -0.46),
    "right_hip": (-0.10, 0.0),
    "left_hip": (0.10, 0.0),
    "right_elbow": (-0.30, -0.22),
    "left_elbow": (0.30, -0.22),
    "right_knee": (-0.12, 0.42),
    "left_knee": (0.12, 0.42),
    "right_wrist": (-0.34, 0.04),
    "left_wrist": (0.34, 0.04),
    "right_ankle": (-0.13, 0.82),
    "left_ankle": (0.13, 0.82),
}
PARTS = {
    "torso": ("neck", "belly", "right_shoulder", "left_shoulder", "right_hip", "left_hip"),
    "head": ("neck", "face"),
    "right_upper_arm": ("right_shoulder", "right_elbow"),
    "left_upper_arm": ("left_shoulder", "left_elbow"),
    "right_lower_arm": ("right_elbow", "right_wrist"),
    "left_lower_arm": ("left_elbow", "left_wrist"),
    "right_upper_leg": ("right_hip", "right_knee"),
    "left_upper_leg": ("left_hip", "left_knee"),
    "right_lower_leg": ("right_knee", "right_ankle"),
    "left_lower_leg": ("left_knee", "left_ankle"),
}
RADIUS = {"torso": 0.15, "head": 0.10, "upper_arm": 0.05, "lower_arm": 0.045, "upper_leg": 0.08, "lower_leg": 0.06}


class CapsuleModel:
    """Ten capsules between the fifteen joints; its prior energy is zero."""

    name = "capsules"
    tree = PartTree.from_parents(DS10_PARENTS)
    joint_names = tuple(MEAN)
    part_joints = tuple(tuple(list(MEAN).index(joint) for joint in joints) for joints in PARTS.values())
    bone = np.array([joints[:2] for joints in part_joints])

    @property
    def shoulder_width(self) -> float:
        return float(np.ptp(self.mean_joints()[[NAMES.index("left_shoulder"), NAMES.index("right_shoulder")], 0]))

    def mean_joints(self) -> Floats:
        """Return the upright person of `MEAN`."""
        return np.array(list(MEAN.values()))

    def estimate_scale(self, joints: Floats, confidence: Floats) -> float:
        """Return the ratio of the joints' spread to that of the mean joints; InputError for fewer than two places."""
        known = np.isfinite(joints).all(axis=1) & (confidence > 0)
        spread = np.linalg.norm(joints[known] - joints[known].mean(axis=0)) if known.sum() > 1 else 0.0
        if not spread > 0:
            raise InputError("the scale needs two joints apart")
        mean = self.mean_joints()[known]
        return float(spread / np.linalg.norm(mean - mean.mean(axis=0)))

    def estimate_view(self, joints: Floats, confidence: Floats) -> View:
        """Return front when the left shoulder is to the right of the right one in the image."""
        left, right = (joints[list(MEAN).index(side + "_shoulder"), 0] for side in ("left", "right"))
        return "back" if left < right else "front"

    def complete_joints(self, joints: Floats, confidence: Floats, scale: float, view: View) -> Floats:
        """Place unknown joints where the mean person has them relative to the known ones."""
        known = np.isfinite(joints).all(axis=1)
        mean = self.mean_joints() * scale * np.array([1.0 if view == "front" else -1.0, 1.0])
        offset = (joints[known] - mean[known]).mean(axis=0)
        return np.where(known[:, None], joints, mean + offset)

    def puppet_from_joints(self, joints: Floats, scale: float, view: View = "front") -> PuppetShape:
        """Put capsules around the bones."""
        contours = []
        for name, (a, b) in zip(self.tree.names, self.bone, strict=True):
            radius = RADIUS[name.removeprefix("right_").removeprefix("left_")] * scale
            contours.append(capsule(joints[a], joints[b], radius))
        return PuppetShape(joints, tuple(contours), tuple(np.zeros(1) for _ in contours), scale, view)

    def puppets_from_joints(
        self, joints: Floats, scale: Floats, view: View = "front", edges: Sequence[int] | None = None
    ) -> tuple[tuple[Floats, ...], Floats]:
        """Do the same for P people (P, J, 2): return contours (P, K, 2) of every part, and no energy."""
        shapes = [self.puppet_from_joints(own, size, view) for own, size in zip(joints, scale, strict=True)]
        return tuple(np.array(part) for part in zip(*(s.contours for s in shapes), strict=True)), np.zeros(len(joints))

    def energy(self, shape: PuppetShape) -> float:
        """Return 0: there is no prior."""
        return 0.0


def capsule(a: Floats, b: Floats, radius: float) -> Floats:
    """Return the outline (26, 2) of the points within `radius` of the segment from a to b."""
    along = np.arctan2(b[1] - a[1], b[0] - a[0])
    half = np.linspace(np.pi / 2, 3 * np.pi / 2, 13) + along
    first = a + radius * np.column_stack([np.cos(half), np.sin(half)])
    return np.vstack([first, b + radius * np.column_stack([np.cos(half + np.pi), np.sin(half + np.pi)])])


NAMES = tuple(MEAN)
SCALE = 160.0
SIZE = (320, 240)
rng = np.random.default_rng(11)
NOISE = {name: rng.integers(40, 255, (48, 48, 3)).astype(np.uint8) for name in CapsuleModel.tree.names}
BACKGROUND = cv2.resize(rng.integers(0, 200, (60, 80, 3)).astype(np.uint8), SIZE, interpolation=cv2.INTER_CUBIC)


def pose(time: float, offset: tuple[float, float] = (150, 118)) -> Floats:
    """Return the joints (15, 2) px: the person walks right, and the left forearm swings about its elbow."""
    joints = CapsuleModel().mean_joints() * SCALE + offset + [1.5 * time, 0.0]
    elbow, wrist = NAMES.index("left_elbow"), NAMES.index("left_wrist")
    angle = -0.05 * time
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    joints[wrist] = joints[elbow] + turn @ (joints[wrist] - joints[elbow])
    return np.asarray(joints)


def draw(*people: Floats, shirts: Sequence[tuple[float, float, float]] = ()) -> NDArray[np.uint8]:
    """Draw people whose capsules move with their own texture; later people stand in front of earlier ones.

    `shirts` are the people's colours: factors on red, green and blue of the texture.
    """
    image = BACKGROUND.copy()
    for joints, shirt in zip(people, [*shirts, *[(1.0, 1.0, 1.0)] * (len(people) - len(shirts))], strict=True):
        shape = CapsuleModel().puppet_from_joints(joints, SCALE)
        for part, contour in enumerate(shape.contours):
            a, b = joints[CapsuleModel.bone[part]]
            along = (b - a) / np.linalg.norm(b - a)
            texture = cv2.resize(NOISE[CapsuleModel.tree.names[part]], None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
            move = np.column_stack([along, [-along[1], along[0]], a - 96 * (along + np.array([-along[1], along[0]]))])
            mask = cv2.fillPoly(np.zeros(SIZE[::-1], np.uint8), [np.round(contour).astype(np.int32)], 1)
            drawn = cv2.warpAffine(texture, move, SIZE) * np.asarray(shirt)
            cv2.copyTo(drawn.astype(np.uint8), mask, image)
    return image


def detection(joints: Floats, confidence: float = 0.9) -> Keypoints:
    """Return the person as a detector reports it."""
    return Keypoints(NAMES, joints.copy(), np.full(len(joints), confidence))


def tracker(**settings: float) -> FlowingPuppetTracker:
    """Make a tracker with the capsule model."""
    return FlowingPuppetTracker(CapsuleModel(), TrackerSettings(**settings))  # type: ignore[arg-type]


def error(result: TrackResult, truth: Floats, name: str) -> float:
    """Return the distance in px of the only puppet's joint from its true place."""
    (puppet,) = result.puppets
    return float(np.linalg.norm((puppet.joints - truth)[NAMES.index(name)]))
