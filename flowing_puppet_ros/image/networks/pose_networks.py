# SPDX-License-Identifier: Apache-2.0
"""MoveNet MultiPose and BlazePose: how their inputs are made and their outputs read.

MoveNet finds up to six people in an image, or the people in a square of it; BlazePose the 33 landmarks of one person,
in a square turned along the trunk.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64, U8, Array, Image
from flowing_puppet_ros.image.formats.skeletons import COCO_17, MEDIAPIPE_33
from flowing_puppet_ros.image.networks.decoders import decode_movenet
from flowing_puppet_ros.image.networks.files import BLAZEPOSE, MOVENET, read_file
from flowing_puppet_ros.image.networks.poses import (
    HIPS,
    SHOULDERS,
    NetworkPose,
    Warp,
    cut_square,
    find_square,
    fit_to_canvas,
)
from flowing_puppet_ros.image.networks.runtime import LiteRtNetwork, Network
from flowing_puppet_ros.image.person_mask import PersonMask

SIDE_PX = 256
LANDMARKS = 33
COCO_ROWS = [MEDIAPIPE_33.index(name) for name in COCO_17]
"""The landmarks that are COCO_17's joints, in COCO_17's order."""
EXTRA = {"left_hand": 19, "right_hand": 20, "left_heel": 29, "right_heel": 30, "left_foot": 31, "right_foot": 32}
"""Landmarks that COCO_17 lacks: index fingers, heels and toes."""

MARGIN = 1.5  # of the square around the person
TRUNK_REACH, JOINT_REACH = 1.2, 1.1  # of the square's half side: trunks, and distances of the farthest joint
MIN_HALF_PX = 1.0


class MoveNet:
    """The network, and how its input and output are read."""

    def __init__(self, network: Network) -> None:
        self._network = network

    @classmethod
    def load(cls) -> MoveNet:
        """Load the installed weights; InputError where there are none."""
        return cls(LiteRtNetwork(read_file(MOVENET)))

    def detect(self, image: Image, side: int) -> list[NetworkPose]:
        """Return the people in an image (H, W, 3) RGB, seen with its longer side reduced to `side` px."""
        return self._run(*fit_to_canvas(image, side))

    def detect_in_square(self, image: Image, center: F64, half: float, side: int) -> list[NetworkPose]:
        """Return the people in a square of an image, see `cut_square`."""
        return self._run(*cut_square(image, center, half, side))

    def _run(self, canvas: Image, warp: Warp) -> list[NetworkPose]:
        people = decode_movenet(self._network.run(canvas[None]), (canvas.shape[1], canvas.shape[0]), len(COCO_17))
        return [NetworkPose(warp.to_image(joints), scores, score) for joints, scores, score in people]


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """Landmarks of one person: `points` (33, 2) px, `visibility` (33,) and `presence` of the person, in [0, 1].

    `mask` is where the person is in the image, None from a network that does not say it.
    """

    points: F64
    visibility: F64
    presence: float
    mask: PersonMask | None = None

    @property
    def pose(self) -> NetworkPose:
        """The landmarks that are joints of COCO_17; their scores are the visibilities."""
        return NetworkPose(self.points[COCO_ROWS], self.visibility[COCO_ROWS], self.presence)


class BlazePose:
    """The network, and how its input and output are read."""

    def __init__(self, network: Network) -> None:
        self._network = network

    @classmethod
    def load(cls) -> BlazePose:
        """Load the installed weights; InputError where there are none."""
        return cls(LiteRtNetwork(read_file(BLAZEPOSE)))

    def locate(self, image: Image, pose: NetworkPose) -> Landmarks:
        """Return the landmarks of the person of a `pose` in an image (H, W, 3) RGB."""
        center, half = find_square(pose, TRUNK_REACH, JOINT_REACH, MIN_HALF_PX)
        square, warp = cut_square(image, center, MARGIN * half, SIDE_PX, angle=find_angle(pose))
        outputs = self._network.run(square[None].astype(np.float32) / 255)
        values = np.asarray(outputs[0], np.float64).reshape(-1, 5)[:LANDMARKS]
        return Landmarks(
            warp.to_image(values[:, :2] - 0.5),
            _sigmoid(values[:, 3]),
            float(np.asarray(outputs[1]).ravel()[0]),
            PersonMask(_to_bytes(outputs[2].reshape(SIDE_PX, SIDE_PX)), warp.matrix),
        )


def find_angle(pose: NetworkPose) -> float:
    """Return the angle by which the trunk of a person is turned clockwise from upright, radians."""
    along = pose.joints[list(SHOULDERS)].mean(axis=0) - pose.joints[list(HIPS)].mean(axis=0)
    return float(np.arctan2(along[0], -along[1])) if pose.trunk > 1.0 else 0.0


def _sigmoid(values: F64) -> F64:
    return np.asarray(1 / (1 + np.exp(-np.clip(values, -30, 30))))


def _to_bytes(shares: Array) -> U8:
    """Return probabilities in [0, 1] as 0 to 255."""
    return np.asarray(np.rint(255 * np.clip(shares, 0.0, 1.0)), dtype=np.uint8)
