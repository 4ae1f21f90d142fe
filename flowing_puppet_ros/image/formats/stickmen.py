# SPDX-License-Identifier: Apache-2.0
"""Stick figures of upper bodies, six sticks a person, and the text files of the Buffy Stickmen that hold them.

A file lists people: the number of the frame, then x1 y1 x2 y2 of each stick in pixels (Ferrari, Marin-Jimenez and
Zisserman, "Progressive Search Space Reduction for Human Pose Estimation", CVPR 2008). Left is the person's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoints import EARS_HEIGHT

STICKS = ("torso", "left_upper_arm", "right_upper_arm", "left_lower_arm", "right_lower_arm", "head")
NUMBERS_A_PERSON = 1 + 4 * len(STICKS)
MOST_BYTES = 100_000_000


def sticks_from_joints(joint_names: Sequence[str], joints: F64) -> F64:
    """Sticks (6, 2, 2) px of a puppet's joints (J, 2): first the end nearer to the neck; NaN where a joint is unknown.

    The torso runs from the middle of the shoulders to that of the hips, the head from the neck to its top.
    """
    place = {name: np.asarray(joint, dtype=np.float64) for name, joint in zip(joint_names, joints, strict=True)}
    shoulders = (place["left_shoulder"] + place["right_shoulder"]) / 2
    hips = (place["left_hip"] + place["right_hip"]) / 2
    top = place["neck"] + (place["face"] - place["neck"]) / EARS_HEIGHT
    arms = [(place[f"{side}_shoulder"], place[f"{side}_elbow"]) for side in ("left", "right")]
    arms += [(place[f"{side}_elbow"], place[f"{side}_wrist"]) for side in ("left", "right")]
    return np.array([(shoulders, hips), *arms, (place["neck"], top)])


def write_sticks(path: Path, frames: Mapping[int, Sequence[F64]]) -> None:
    """Write sticks (6, 2, 2) by frame number, a line of 25 numbers a person; unknown ends are written as nan."""
    lines = [
        " ".join([str(number), *(f"{value:.2f}" for value in person.ravel())])
        for number, people in sorted(frames.items())
        for person in people
    ]
    path.write_text("".join(line + "\n" for line in lines))


def read_sticks(path: Path) -> dict[int, list[F64]]:
    """Sticks (6, 2, 2) of the people of each frame, wherever the lines break; InputError when it is no such file."""
    try:
        if path.stat().st_size > MOST_BYTES:
            raise InputError(f"{path} has {path.stat().st_size} bytes, too many for a file of sticks")
        numbers = np.array(path.read_text().split(), dtype=np.float64)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise InputError(f"{path} holds more than numbers; a file of sticks has 25 numbers a person") from error
    if len(numbers) == 0 or len(numbers) % NUMBERS_A_PERSON:
        raise InputError(
            f"{path} has {len(numbers)} numbers; a person has {NUMBERS_A_PERSON} there: the frame and 6 x (x1 y1 x2 y2)"
        )
    people: dict[int, list[F64]] = {}
    for row in numbers.reshape(-1, NUMBERS_A_PERSON):
        if not (row[0] >= 0 and row[0].is_integer()):
            raise InputError(f"{path} has a person in frame {row[0]:g}; frames are counted in whole numbers")
        people.setdefault(int(row[0]), []).append(row[1:].reshape(len(STICKS), 2, 2))
    return people
