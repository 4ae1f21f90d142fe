# SPDX-License-Identifier: Apache-2.0
"""Painted upper bodies on a cluttered background, with their joints: images to train and test a detector on."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from flowing_puppet_ros.image.formats.keypoints import Keypoints

type Floats = NDArray[np.float64]

NAMES = (
    *("neck", "belly", "face", "right_shoulder", "left_shoulder", "right_hip", "left_hip"),
    *("right_elbow", "left_elbow", "right_wrist", "left_wrist"),
)
SIZE = (240, 180)


def ground(rng: np.random.Generator, size: tuple[int, int] = SIZE) -> NDArray[np.uint8]:
    """Paint a background of blotches with a few lines and boxes."""
    image = cv2.resize(rng.integers(0, 256, (7, 9, 3)).astype(np.uint8), size, interpolation=cv2.INTER_CUBIC)
    for _ in range(6):
        a, b = (tuple(int(v) for v in rng.integers(0, size)) for _ in range(2))
        colour = tuple(int(v) for v in rng.integers(0, 256, 3))
        if rng.random() < 0.5:
            cv2.line(image, a, b, colour, int(rng.integers(1, 8)))
        else:
            cv2.rectangle(image, a, b, colour, int(rng.integers(1, 8)))
    return np.asarray(image, np.uint8)


def joints_at(neck: tuple[float, float], scale: float, rng: np.random.Generator) -> Floats:
    """Return the joints (11, 2) of a person with shoulders `scale` px wide and random arms."""
    place = {"neck": (0.0, 0.0), "belly": (0.0, 1.0), "face": (0.0, -0.45)}
    place |= {"right_shoulder": (-0.5, 0.15), "left_shoulder": (0.5, 0.15)}
    place |= {"right_hip": (-0.3, 1.6), "left_hip": (0.3, 1.6)}
    for side, sign in (("right", -1), ("left", 1)):
        upper = rng.uniform(-0.2, 1.2)
        lower = upper + rng.uniform(-0.3, 2.0)
        shoulder = np.array(place[f"{side}_shoulder"])
        elbow = shoulder + 0.75 * np.array([sign * np.sin(upper), np.cos(upper)])
        place[f"{side}_elbow"] = tuple(elbow)
        place[f"{side}_wrist"] = tuple(elbow + 0.65 * np.array([sign * np.sin(lower), np.cos(lower)]))
    return np.array([place[name] for name in NAMES]) * scale + neck


def paint(image: NDArray[np.uint8], joints: Floats, scale: float, rng: np.random.Generator) -> None:
    """Paint a person with a shirt, bare forearms, face and hair onto the image."""
    at = {name: tuple(int(v) for v in np.round(joint)) for name, joint in zip(NAMES, joints, strict=True)}
    shirt, hair = (tuple(int(v) for v in rng.integers(0, 256, 3)) for _ in range(2))
    skin = tuple(int(v) for v in np.array([215, 160, 125]) * rng.uniform(0.6, 1.1))
    thick = max(1, round(0.22 * scale))
    corners = [at[name] for name in ("right_shoulder", "left_shoulder", "left_hip", "right_hip")]
    cv2.fillPoly(image, [np.array(corners, np.int32)], shirt)
    cv2.line(image, at["right_shoulder"], at["left_shoulder"], shirt, thick)
    cv2.line(image, at["neck"], at["face"], skin, thick)
    cv2.ellipse(image, at["face"], (round(0.2 * scale), round(0.28 * scale)), 0, 0, 360, skin, -1)
    cv2.ellipse(image, at["face"], (round(0.22 * scale), round(0.3 * scale)), 0, 180, 360, hair, thick // 2 + 1)
    for side in ("right", "left"):
        cv2.line(image, at[f"{side}_shoulder"], at[f"{side}_elbow"], shirt, thick)
        cv2.line(image, at[f"{side}_elbow"], at[f"{side}_wrist"], skin, round(0.8 * thick))
        cv2.circle(image, at[f"{side}_wrist"], round(0.13 * scale), skin, -1)


def picture(
    rng: np.random.Generator, scale: float | None = None, size: tuple[int, int] = SIZE
) -> tuple[NDArray[np.uint8], Floats, float]:
    """Paint a picture (H, W, 3) with one person; return it, their joints (11, 2) and shoulder width, all in px."""
    width = float(rng.uniform(30, 50)) if scale is None else scale
    neck = rng.uniform((1.2 * width, 0.9 * width), (size[0] - 1.2 * width, size[1] - 1.7 * width))
    joints = joints_at((float(neck[0]), float(neck[1])), width, rng)
    image = ground(rng, size)
    paint(image, joints, width, rng)
    return image, joints, width


def keypoints(joints: Floats) -> Keypoints:
    """Return the joints as an annotation."""
    return Keypoints(NAMES, joints, np.ones(len(NAMES)))
