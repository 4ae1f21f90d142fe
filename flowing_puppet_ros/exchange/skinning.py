# SPDX-License-Identifier: Apache-2.0
"""Which bones move each vertex, by how much (linear blend skinning)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from flowing_puppet_ros.arrays import F64, I64, Array
from flowing_puppet_ros.exchange.bones import BONES, PARENTS, BonePoses
from flowing_puppet_ros.model.sp import StitchedPuppet

MAX_BONES = 4
"""Bones of a vertex, as glTF has them in one attribute."""
BLEND_M = 0.03
"""Distance from the border of two parts, or from the joint within the torso, over which their bones blend."""


@lru_cache(maxsize=3)
def weigh_bones(model: StitchedPuppet) -> tuple[I64, F64]:
    """Return the bones (V, 4) of each vertex and their weights (V, 4), which sum to 1; the first is its own part's."""
    rest = model.vertices(model.rest_state())
    weight = np.zeros((len(rest), len(BONES)))
    owner = _choose_owners(model, rest)
    weight[np.arange(len(rest)), owner] = 1.0
    for bone, parent in enumerate(PARENTS):
        if parent < 0:
            continue
        border = _find_border(model, rest, bone, parent)
        for own, other in ((bone, parent), (parent, bone)):
            ids = np.flatnonzero(owner == own)
            distance = cKDTree(border).query(rest[ids])[0]
            weight[ids, other] = np.maximum(weight[ids, other], np.exp(-distance / BLEND_M))
    chosen = np.argsort(-weight, axis=1, kind="stable")[:, :MAX_BONES]
    kept = np.take_along_axis(weight, chosen, axis=1)
    kept[kept < 0.01] = 0.0
    return chosen, kept / kept.sum(axis=1, keepdims=True)


def _choose_owners(model: StitchedPuppet, rest: Array) -> I64:
    """Return the bone (V,) of each vertex's part; of the torso's, those below its inner joint are the hips'."""
    names = [bone.part for bone in BONES]
    of_part = np.array([names.index(name) for name in model.tree.names])
    owner = of_part[model.part_of_vertex]
    belly = model.joints(rest)[model.joint_names.index("belly")]
    return np.asarray(np.where((owner == 0) & (rest[:, 2] > belly[2]), 1, owner), np.int64)


def _find_border(model: StitchedPuppet, rest: Array, bone: int, parent: int) -> F64:
    """Return points (N, 3) of the rest pose where a bone's vertices meet its parent's."""
    parts = model.tree.names
    child, above = parts.index(BONES[bone].part), parts.index(BONES[parent].part)
    if child == above:  # within the torso: the ring at the height of the joint
        belly = model.joints(rest)[model.joint_names.index("belly")]
        torso = model.part_of_vertex == child
        return np.asarray(rest[torso & (np.abs(rest[:, 2] - belly[2]) < BLEND_M / 2)])
    return np.asarray(rest[model.part_vertices[child][model.interfaces[child - 1].child_index]])


def bind(model: StitchedPuppet, bones: BonePoses, vertices: Array) -> F64:
    """Return vertices (V, 3) in the pose of the first frame that, skinned, are nearest to `vertices` (T, V, 3) of all.

    They are exact for one frame. Each frame's vertices are taken back to the first by the inverse of their blend, and
    averaged.
    """
    chosen, weight = weigh_bones(model)
    turn = bones.rotation @ np.swapaxes(bones.rotation[:1], -1, -2)
    shift = bones.position - np.einsum("tbij,tbj->tbi", turn, np.broadcast_to(bones.position[:1], bones.position.shape))
    mean = np.zeros(vertices.shape[1:])
    for t in range(len(vertices)):
        blend = np.einsum("vk,vkij->vij", weight, turn[t][chosen])
        moved = np.einsum("vk,vki->vi", weight, shift[t][chosen])
        mean += np.linalg.solve(blend, (vertices[t] - moved)[..., None])[..., 0]
    return np.asarray(mean / len(vertices))


def skin(model: StitchedPuppet, bones: BonePoses, bound: Array) -> F64:
    """Return the vertices (T, V, 3) of all frames from those in the pose of the first frame, `bound` (V, 3)."""
    chosen, weight = weigh_bones(model)
    local = np.einsum("bji,vbj->vbi", bones.rotation[0], bound[:, None] - bones.position[0])
    local = np.take_along_axis(local, chosen[..., None], axis=1)
    frames = [
        np.einsum("vk,vki->vi", weight, np.einsum("vkij,vkj->vki", turn[chosen], local) + place[chosen])
        for turn, place in zip(bones.rotation, bones.position, strict=True)
    ]
    return np.stack(frames)
