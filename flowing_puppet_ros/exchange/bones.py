# SPDX-License-Identifier: Apache-2.0
"""A skeleton over the 16 parts and the joints of the Stitched Puppet, as animation formats want one.

Every bone begins at a joint and turns with a part. The parts of a fit are held together by stitching only, and the
torso bends within itself, so the turn of each bone is corrected such that it points at the joints at its end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64, Array
from flowing_puppet_ros.model.sp import StitchedPuppet

_AXIS_M = 0.02
"""Length of the axes by which a bone keeps the turn of its part about its own length."""
_TURNS = 2
"""Corrections of the bones' turns; the second has the lengths of the first."""


@dataclass(frozen=True, slots=True)
class Bone:
    """One bone.

    Attributes:
        name: its name.
        parent: name of the bone that it hangs on, "" for the root.
        joint: the joint at which it begins; "" for the border between two parts.
        part: the part that it turns with.
        ends: joints that it carries, the first at its end.
    """

    name: str
    parent: str
    joint: str
    part: str
    ends: tuple[str, ...]


def _make_side(side: str) -> tuple[Bone, ...]:
    return tuple(
        Bone(f"{side}_{name}", parent if parent == "spine" or parent == "hips" else f"{side}_{parent}",
             joint and f"{side}_{joint}", f"{side}_{part}", tuple(f"{side}_{end}" for end in ends))
        for name, parent, joint, part, ends in (
            ("collar", "spine", "", "shoulder", ("shoulder",)),
            ("upper_arm", "collar", "shoulder", "upper_arm", ("elbow",)),
            ("lower_arm", "upper_arm", "elbow", "lower_arm", ("wrist",)),
            ("hand", "lower_arm", "wrist", "hand", ("hand",)),
            ("upper_leg", "hips", "hip", "upper_leg", ("knee",)),
            ("lower_leg", "upper_leg", "knee", "lower_leg", ("ankle",)),
            ("foot", "lower_leg", "ankle", "foot", ("toe", "foot", "heel")),
        )
    )  # fmt: skip


BONES = (
    Bone("hips", "", "pelvis", "torso", ("belly", "right_hip", "left_hip")),
    Bone("spine", "hips", "belly", "torso", ("neck", "right_shoulder", "left_shoulder")),
    Bone("head", "spine", "neck", "head", ("head_top", "nose", "right_ear", "left_ear")),
    *_make_side("right"),
    *_make_side("left"),
)
"""Every bone comes after its parent. The template's pose has all turns at identity."""
NAMES = tuple(bone.name for bone in BONES)
PARENTS = tuple(NAMES.index(bone.parent) if bone.parent else -1 for bone in BONES)


@dataclass(frozen=True, slots=True, eq=False)
class BonePoses:
    """Turn `rotation` (T, B, 3, 3) from the template's pose and beginning `position` (T, B, 3) of all bones."""

    rotation: F64
    position: F64

    def offsets(self) -> F64:
        """Return the mean beginning (B, 3) of every bone in its parent's axes; zero for the root."""
        found = np.zeros((len(BONES), 3))
        for bone, parent in enumerate(PARENTS):
            if parent >= 0:
                steps = self.position[:, bone] - self.position[:, parent]
                found[bone] = np.einsum("tji,tj->ti", self.rotation[:, parent], steps).mean(axis=0)
        return found

    def local_rotations(self) -> F64:
        """Return the turn (T, B, 3, 3) of every bone relative to its parent's."""
        found = self.rotation.copy()
        for bone, parent in enumerate(PARENTS):
            if parent >= 0:
                found[:, bone] = np.swapaxes(self.rotation[:, parent], 1, 2) @ self.rotation[:, bone]
        return found

    def ends(self, joints: Array, names: Sequence[str]) -> F64:
        """Return the mean end (B, 3) of every bone in its own axes, of `joints` (T, J, 3) called `names`."""
        index = [list(names).index(bone.ends[0]) for bone in BONES]
        steps = joints[:, index] - self.position
        return np.asarray(np.einsum("tbji,tbj->tbi", self.rotation, steps).mean(axis=0))


def pose_bones(model: StitchedPuppet, vertices: Array, joints: Array, part_rotation: Array) -> BonePoses:
    """Return the bones of bodies in T frames.

    Args:
        model: whose parts and joints these are.
        vertices: (T, V, 3).
        joints: (T, J, 3).
        part_rotation: (T, 16, 3, 3).
    """
    names = list(model.joint_names)
    position = np.stack(
        [joints[:, names.index(bone.joint)] if bone.joint else _find_border(model, bone, vertices) for bone in BONES],
        axis=1,
    )
    rotation = part_rotation[:, [model.tree.names.index(bone.part) for bone in BONES]].astype(np.float64)
    for _ in range(_TURNS):
        rotation = np.stack(
            [
                _turn(rotation[:, k], joints[:, [names.index(end) for end in bone.ends]] - position[:, k, None])
                for k, bone in enumerate(BONES)
            ],
            axis=1,
        )
    return BonePoses(rotation, position)


def keep_lengths(bones: BonePoses, joints: Array, names: Sequence[str]) -> BonePoses:
    """Return the bones with their mean lengths, hung on one another and turned to the same ends.

    `joints` (T, J, 3) are called `names`. From the hips outwards, each bone turns from where it now begins to where its
    ends are, so that differences of length do not add up.
    """
    names, offsets = list(names), bones.offsets()
    rotation, position = bones.rotation.copy(), bones.position.copy()
    for k, bone in enumerate(BONES):
        parent = PARENTS[k]
        if parent >= 0:
            position[:, k] = position[:, parent] + rotation[:, parent] @ offsets[k]
        ends = joints[:, [names.index(end) for end in bone.ends]]
        mean = np.einsum("tji,tkj->tki", bones.rotation[:, k], ends - bones.position[:, k, None]).mean(axis=0)
        rotation[:, k] = _align(rotation[:, k], mean, ends - position[:, k, None])
    return BonePoses(rotation, position)


def _find_border(model: StitchedPuppet, bone: Bone, vertices: Array) -> F64:
    """Return the middle (T, 3) of the border between a bone's part and its parent part."""
    child = model.tree.names.index(bone.part)
    parent = model.tree.parents[child]
    assert parent is not None
    ids = model.part_vertices[parent][model.interfaces[child - 1].parent_index]
    return np.asarray(vertices[:, ids].mean(axis=1))


def _turn(rotation: F64, ends: Array) -> F64:
    """Return rotations (T, 3, 3) near `rotation` that turn the mean `ends` (T, K, 3) of all frames to each frame's."""
    return _align(rotation, np.einsum("tji,tkj->tki", rotation, ends).mean(axis=0), ends)


def _align(rotation: F64, mean: Array, ends: Array) -> F64:
    """Return rotations (T, 3, 3) near `rotation` that turn `mean` (K, 3) to `ends` (T, K, 3)."""
    axes = _AXIS_M * np.eye(3)
    source = np.concatenate([mean, axes])
    target = np.concatenate([ends, np.swapaxes(rotation @ axes, 1, 2)], axis=1)
    u, _, vt = np.linalg.svd(np.einsum("tki,kj->tij", target, source))
    flip = np.ones((len(ends), 3))
    flip[:, 2] = np.linalg.det(u @ vt)
    return np.asarray((u * flip[:, None]) @ vt)
