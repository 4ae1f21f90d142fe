# SPDX-License-Identifier: Apache-2.0
"""Stick figures of upper bodies, six sticks per person, and their text files as in the Buffy Stickmen data set.

A file lists people: the number of the frame, then x1 y1 x2 y2 of each stick in pixels (Ferrari, Marin-Jimenez and
Zisserman, "Progressive Search Space Reduction for Human Pose Estimation", CVPR 2008). Left is the person's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoints import EAR_HEIGHT

STICKS = ("torso", "left_upper_arm", "right_upper_arm", "left_lower_arm", "right_lower_arm", "head")
NUMBERS_PER_PERSON = 1 + 4 * len(STICKS)
MAX_FILE_BYTES = 100_000_000  # larger files are refused unread


def sticks_from_joints(joint_names: Sequence[str], joints: F64) -> F64:
    """Return the sticks (6, 2, 2) px of `joints` (J, 2) px, the end near the neck first; NaN where one is unknown.

    The torso runs from the middle of the shoulders to that of the hips, the head from the neck to its top.
    """
    joint_of = {name: np.asarray(joint, dtype=np.float64) for name, joint in zip(joint_names, joints, strict=True)}
    shoulders = (joint_of["left_shoulder"] + joint_of["right_shoulder"]) / 2
    hips = (joint_of["left_hip"] + joint_of["right_hip"]) / 2
    top = joint_of["neck"] + (joint_of["face"] - joint_of["neck"]) / EAR_HEIGHT
    arms = [(joint_of[f"{side}_shoulder"], joint_of[f"{side}_elbow"]) for side in ("left", "right")]
    arms += [(joint_of[f"{side}_elbow"], joint_of[f"{side}_wrist"]) for side in ("left", "right")]
    return np.array([(shoulders, hips), *arms, (joint_of["neck"], top)])


def write_sticks(path: Path, frames: Mapping[int, Sequence[F64]]) -> None:
    """Write sticks (6, 2, 2) by frame number, a line of 25 numbers per person; unknown ends are written as nan."""
    lines = [
        " ".join([str(number), *(f"{value:.2f}" for value in person.ravel())])
        for number, people in sorted(frames.items())
        for person in people
    ]
    path.write_text("".join(line + "\n" for line in lines))


def read_sticks(path: Path) -> dict[int, list[F64]]:
    """Read the sticks (6, 2, 2) of the people in each frame, wherever lines break; InputError for any other file."""
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise InputError(
                f"{path} has {path.stat().st_size} bytes, but a file of sticks has at most {MAX_FILE_BYTES}"
            )
        numbers = np.array(path.read_text().split(), dtype=np.float64)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise InputError(f"{path} holds more than numbers; a file of sticks has 25 numbers per person") from error
    if len(numbers) == 0 or len(numbers) % NUMBERS_PER_PERSON:
        raise InputError(
            f"{path} has {len(numbers)} numbers; a person has {NUMBERS_PER_PERSON}: the frame and 6 x (x1 y1 x2 y2)"
        )
    people: dict[int, list[F64]] = {}
    for row in numbers.reshape(-1, NUMBERS_PER_PERSON):
        if not (row[0] >= 0 and row[0].is_integer()):
            raise InputError(f"{path} has a person in frame {row[0]:g}; frames are counted in whole numbers")
        people.setdefault(int(row[0]), []).append(row[1:].reshape(len(STICKS), 2, 2))
    return people
