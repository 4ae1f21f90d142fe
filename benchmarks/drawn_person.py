# SPDX-License-Identifier: Apache-2.0
"""A drawn person who waves and sways before a drawn background: test images for benchmarks."""

from __future__ import annotations

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64, U8

JOINTS = (
    *("neck", "belly", "face", "right_shoulder", "left_shoulder", "right_hip", "left_hip"),
    *("right_elbow", "left_elbow", "right_wrist", "left_wrist"),
)
SKIN, SHIRT, HAIR = (205, 150, 118), (46, 74, 130), (52, 38, 30)  # RGB
SHOULDER_SHARE = 0.19  # shoulder width over the image's height


class DrawnPerson:
    """The upper body of a moving person."""

    def __init__(self, size: tuple[int, int] = (640, 480), seed: int = 0) -> None:
        """Draw the background of `size` (width, height) px."""
        self.size = size
        self._scale = SHOULDER_SHARE * size[1]
        rng = np.random.default_rng(seed)
        blotches = (rng.integers(130, 190, (7, 9, 1)) + rng.integers(-8, 8, (7, 9, 3))).astype(np.uint8)
        self._background = np.asarray(cv2.resize(blotches, size, interpolation=cv2.INTER_CUBIC), np.uint8)
        for _ in range(8):
            corners = [tuple(int(v) for v in rng.integers(0, size)) for _ in range(2)]
            colour = tuple(int(v) for v in rng.integers(90, 220, 3))
            cv2.rectangle(self._background, corners[0], corners[1], colour, int(rng.integers(1, 6)), cv2.LINE_AA)
        grain = rng.normal(0, 6, self._background.shape)
        self._background = np.clip(self._background + grain, 0, 255).astype(np.uint8)

    def locate_joints(self, seconds: float) -> F64:
        """Return the positions (11, 2) px of JOINTS at a time."""
        place = {"neck": (0.0, 0.0), "belly": (0.0, 1.0), "face": (0.0, -0.45)}
        place |= {"right_shoulder": (-0.5, 0.15), "left_shoulder": (0.5, 0.15)}
        place |= {"right_hip": (-0.3, 1.6), "left_hip": (0.3, 1.6)}
        for side, sign, phase in (("right", -1, 0.0), ("left", 1, 2.0)):
            upper = 0.55 + 0.35 * np.sin(1.1 * seconds + phase)
            lower = upper + 0.8 + 0.6 * np.sin(1.9 * seconds + phase)
            shoulder = np.array(place[f"{side}_shoulder"])
            elbow = shoulder + 0.75 * np.array([sign * np.sin(upper), np.cos(upper)])
            place[f"{side}_elbow"] = tuple(elbow)
            place[f"{side}_wrist"] = tuple(elbow + 0.65 * np.array([sign * np.sin(lower), np.cos(lower)]))
        neck = np.array([0.5 + 0.12 * np.sin(0.6 * seconds), 0.36 + 0.02 * np.sin(0.9 * seconds)]) * self.size
        return np.array([place[name] for name in JOINTS]) * self._scale + neck

    def draw(self, seconds: float) -> U8:
        """Draw the image (H, W, 3) RGB at a time."""
        image = self._background.copy()
        at = {name: _to_fixed_point(joint) for name, joint in zip(JOINTS, self.locate_joints(seconds), strict=True)}
        scale, thick = self._scale, max(1, round(0.22 * self._scale))
        trunk = [at[name] for name in ("right_shoulder", "left_shoulder", "left_hip", "right_hip")]
        cv2.fillPoly(image, [np.array(trunk, np.int32)], SHIRT, cv2.LINE_AA, 4)
        _draw_line(image, at["right_shoulder"], at["left_shoulder"], SHIRT, thick)
        _draw_line(image, at["neck"], at["face"], SKIN, thick)
        head = at["face"], (16 * round(0.2 * scale), 16 * round(0.28 * scale))
        cv2.ellipse(image, *head, 0, 0, 360, SKIN, -1, cv2.LINE_AA, 4)
        crown = at["face"], (16 * round(0.22 * scale), 16 * round(0.3 * scale))
        cv2.ellipse(image, *crown, 0, 180, 360, HAIR, thick // 2 + 1, cv2.LINE_AA, 4)
        for side in ("right", "left"):
            _draw_line(image, at[f"{side}_shoulder"], at[f"{side}_elbow"], SHIRT, thick)
            _draw_line(image, at[f"{side}_elbow"], at[f"{side}_wrist"], SKIN, round(0.8 * thick))
            cv2.circle(image, at[f"{side}_wrist"], 16 * round(0.13 * scale), SKIN, -1, cv2.LINE_AA, 4)
        return image


def _to_fixed_point(joint: F64) -> tuple[int, int]:
    """Convert a position to sixteenths of a pixel, as OpenCV's drawing functions take it with a shift of 4."""
    return round(16 * float(joint[0])), round(16 * float(joint[1]))


def _draw_line(image: U8, a: tuple[int, int], b: tuple[int, int], colour: tuple[int, ...], width: int) -> None:
    cv2.line(image, a, b, colour, width, cv2.LINE_AA, 4)
