# SPDX-License-Identifier: Apache-2.0
"""Joints of the Deformable Structures puppets and the parts they belong to (left and right are the person's)."""

from __future__ import annotations

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.tree import DS10_PARENTS, DS14_PARENTS, PartTree

_JOINTS_15 = (
    *("neck", "belly", "face", "right_shoulder", "left_shoulder", "right_hip", "left_hip", "right_elbow", "left_elbow"),
    *("right_knee", "left_knee", "right_wrist", "left_wrist", "right_ankle", "left_ankle"),
)
JOINT_NAMES = {10: _JOINTS_15, 14: (*_JOINTS_15, "right_hand", "left_hand", "right_foot", "left_foot")}
"""Joint names by number of parts."""

_LIMBS = {
    "upper_arm": ("shoulder", "elbow"),
    "lower_arm": ("elbow", "wrist"),
    "hand": ("wrist", "hand"),
    "upper_leg": ("hip", "knee"),
    "lower_leg": ("knee", "ankle"),
    "foot": ("ankle", "foot"),
}
PART_JOINTS: dict[str, tuple[str, ...]] = {
    "torso": ("neck", "belly", "right_shoulder", "left_shoulder", "right_hip", "left_hip"),
    "head": ("neck", "face"),
} | {
    f"{side}_{limb}": (f"{side}_{proximal}", f"{side}_{distal}")
    for side in ("right", "left")
    for limb, (proximal, distal) in _LIMBS.items()
}
"""Joints of each part: proximal, distal, then the torso's others."""


def part_tree(parts: int) -> PartTree:
    """Return the tree of the model of 10 `parts` (hands belong to lower arms, feet to lower legs) or of 14."""
    if parts not in JOINT_NAMES:
        raise InputError(f"there is no puppet of {parts} parts; choose 10 or 14")
    return PartTree.from_parents(DS10_PARENTS if parts == 10 else DS14_PARENTS)
