# SPDX-License-Identifier: Apache-2.0
"""Fixed colours of the body parts: the person's left is warm, the right is cool, the midline is neutral.

Neighbouring parts of one limb also differ in lightness, so that they can be told apart without colour vision. People
have colours too, by their ids.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterable, Sequence

import numpy as np

PART_COLOURS: dict[str, tuple[int, int, int]] = {
    "torso": (196, 200, 190),
    "head": (206, 132, 190),
    "left_shoulder": (255, 222, 120),
    "left_upper_arm": (250, 170, 30),
    "left_lower_arm": (255, 222, 120),
    "left_hand": (205, 60, 30),
    "left_upper_leg": (216, 84, 36),
    "left_lower_leg": (250, 170, 110),
    "left_foot": (165, 40, 40),
    "right_shoulder": (150, 220, 245),
    "right_upper_arm": (60, 140, 220),
    "right_lower_arm": (150, 220, 245),
    "right_hand": (50, 70, 185),
    "right_upper_leg": (20, 120, 130),
    "right_lower_leg": (100, 205, 185),
    "right_foot": (40, 70, 130),
}
NEUTRAL = (170, 170, 170)  # of unknown parts
PERSON_COLOURS = (
    (0, 114, 178),
    (213, 94, 0),
    (0, 158, 115),
    (204, 121, 167),
    (86, 180, 233),
    (230, 159, 0),
    (150, 110, 60),
)
"""Colours of people in the order of the numbers in their ids; they differ without colour vision, too."""


def part_colours(names: Sequence[str]) -> np.ndarray:
    """Return the RGB colour of each part, (N, 3) uint8; parts that are not in the palette are grey."""
    return np.array([PART_COLOURS.get(name, NEUTRAL) for name in names], np.uint8).reshape(-1, 3)


def joint_colour(name: str) -> tuple[int, int, int]:
    """Return the RGB colour of a joint: orange on the person's left, blue on the right, white on the midline."""
    if name.startswith("left_"):
        return (255, 140, 0)
    if name.startswith("right_"):
        return (30, 110, 255)
    return (255, 255, 255)


def list_person_colours(ids: Iterable[str]) -> dict[str, tuple[int, int, int]]:
    """Return the RGB colour of each person by the order of the `ids`, which need not have numbers; they repeat."""
    return {identity: PERSON_COLOURS[k % len(PERSON_COLOURS)] for k, identity in enumerate(ids)}


def person_colour(identity: str) -> tuple[int, int, int]:
    """Return the RGB colour of a person by the number that the id (`a1`, `a2`, ...) ends with, or by its letters.

    Neighbouring numbers differ; ids of letters alone, as REP-155 has them, may share a colour, but each keeps its own.
    """
    number = re.search(r"\d*$", identity)
    place = int(number[0]) - 1 if number and number[0] else zlib.crc32(identity.encode())
    return PERSON_COLOURS[place % len(PERSON_COLOURS)]
