# SPDX-License-Identifier: Apache-2.0
"""MoveNet MultiPose: up to six people in an image, or the people in a square of it."""

from __future__ import annotations

import numpy as np

from flowing_puppet_ros.arrays import F64, Array, Image
from flowing_puppet_ros.image.networks.files import MOVENET, read_file
from flowing_puppet_ros.image.networks.poses import COCO, NetworkPose, Warp, cut_square, fit_to_canvas
from flowing_puppet_ros.image.networks.runtime import LiteRtNetwork, Network

VALUES = 3 * len(COCO)  # y, x and score of each joint, then the box and its score


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
        people = np.asarray(self._network.run(canvas[None])[0], np.float64)[0]
        return decode_multipose(people, (canvas.shape[1], canvas.shape[0]), warp)


def decode_multipose(people: Array, size: tuple[int, int], warp: Warp) -> list[NetworkPose]:
    """Return the people (N, 56) of MoveNet MultiPose whose score is above nothing; `size` is the input's."""
    poses = []
    for row in people:
        if not (np.isfinite(row).all() and row[-1] > 0):
            continue
        values = row[:VALUES].reshape(-1, 3)
        joints = warp.to_image(values[:, 1::-1] * size - 0.5)
        poses.append(NetworkPose(joints, values[:, 2].copy(), float(row[-1])))
    return poses
