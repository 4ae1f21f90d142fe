# SPDX-License-Identifier: Apache-2.0
"""Learn a Stitched Puppet from Anny bodies (thesis section "Learning" of the Stitched Puppet chapter)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.learn.anny.body import AnnyBody, RestBody
from flowing_puppet_ros.learn.anny.poses import PoseSampler
from flowing_puppet_ros.learn.sp.joints import regress_joints
from flowing_puppet_ros.learn.sp.pca import MIRROR, MeshSpace, fit_space
from flowing_puppet_ros.learn.sp.pose_spaces import (
    TREE,
    fit_pose_spaces,
    index_mirror_vertices,
    learn_pairwise,
    pose_parts,
)
from flowing_puppet_ros.learn.sp.template import Template, make_template
from flowing_puppet_ros.model.gaussian import Gaussian
from flowing_puppet_ros.model.sp import PartTopology
from flowing_puppet_ros.settings import Settings, setting

STRETCHED_SIDE_WEIGHT = 0.8  # weight in Eq. 48 of the front of the knee and the back of the elbow


@dataclass(frozen=True, slots=True)
class LearnSettings(Settings):
    """How much data a Stitched Puppet is learned from."""

    shapes: int = setting(600, "bodies of different shape", low=30, high=20000)
    poses: int = setting(4000, "poses of the average body", low=200, high=100000)
    shape_count: int = setting(10, "intrinsic shape coefficients", low=1, high=29)
    seed: int = setting(0, "seed of everything random", low=0, high=2**31 - 1)


@dataclass(frozen=True, slots=True, eq=False)
class LearnedPuppet:
    """The arrays of a weights file, and the figures of its model card."""

    arrays: dict[str, Array]
    shape_space: MeshSpace
    pose_spaces: tuple[MeshSpace, ...]
    joint_error: dict[str, float]


def learn_puppet(
    gender: str, settings: LearnSettings, mocap: Path | None, report: Callable[[str], None]
) -> LearnedPuppet:
    """Learn the model of one gender; all models share the neutral template, so that their vertices correspond.

    InputError if the packages for learning or the motion capture cannot be used.
    """
    body, neutral = AnnyBody(gender), AnnyBody("neutral")
    rng = np.random.default_rng(settings.seed)
    poses = PoseSampler(body, mocap)
    report("template mesh")
    template = make_template(neutral)
    topology = PartTopology.from_faces(template.faces, template.part_of_face, TREE)
    area = vertex_area(body.make_rest_body(body.mean_phenotype()).vertices[template.anny_vertex], template.faces)
    report(f"{settings.shapes} shapes")
    people = [body.make_rest_body(body.sample_phenotype(rng)) for _ in range(settings.shapes)]
    shape_space, rest_center = _fit_shape_space(people, template, topology, area, settings.shape_count)
    report(f"{settings.poses} poses")
    hands = np.random.default_rng([settings.seed, 1])
    posed = pose_parts(body, template, topology, poses.sample(rng, settings.poses), area, hands)
    report("pose deformations of the parts")
    spaces, signs = fit_pose_spaces(posed, template, topology, area)
    pairwise, low, high = learn_pairwise(posed, spaces, signs)
    report("joints")
    names, joint_index, joint_weight, error = _learn_joints(body, people, poses, template, rng)
    stretch = _make_interface_weights(body, template, topology)
    arrays = _pack_topology(template) | _pack_spaces(topology, shape_space, spaces, signs)
    arrays |= _pack_edges(pairwise, stretch) | {
        "rest_center": rest_center.astype(np.float32),
        "limit_low": low.astype(np.float32),
        "limit_high": high.astype(np.float32),
        "joint_names": np.array(names),
        "joint_index": joint_index,
        "joint_weight": joint_weight.astype(np.float32),
    }
    return LearnedPuppet(arrays, shape_space, spaces, error)


def vertex_area(vertices: Array, faces: Array) -> Array:
    """Return a third of the area (V,) m^2 of the faces (F, 3) around each vertex (V, 3) m."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    return np.asarray(np.bincount(faces.ravel(), np.repeat(area, 3), minlength=len(vertices)))


def _fit_shape_space(
    people: list[RestBody], template: Template, topology: PartTopology, area: Array, count: int
) -> tuple[MeshSpace, Array]:
    # One space over the stacked parts, each relative to its centre (thesis section 2).
    bodies = np.stack([person.vertices[template.anny_vertex] for person in people])
    centres = np.stack([bodies[:, ids].mean(axis=1) for ids in topology.part_vertices], axis=1)
    stacked = np.concatenate([bodies[:, ids] - centres[:, [i]] for i, ids in enumerate(topology.part_vertices)], axis=1)
    weight = np.concatenate([area[ids] for ids in topology.part_vertices])
    space = fit_space(stacked, weight, count)
    starts = np.cumsum([0, *map(len, topology.part_vertices)])
    across = np.concatenate(
        [starts[TREE.mirror[i]] + index_mirror_vertices(template, topology, i) for i in range(len(TREE))]
    )
    mean = (space.mean + space.mean[across] * MIRROR) / 2
    basis = (space.basis + space.basis[across] * MIRROR[:, None]) / 2
    centre = centres.mean(axis=0)
    centre = (centre + centre[list(TREE.mirror)] * MIRROR) / 2
    return MeshSpace(mean, basis, weight, space.share, space.residual), centre


def _make_interface_weights(body: AnnyBody, template: Template, topology: PartTopology) -> list[Array]:
    rest = body.make_rest_body(body.mean_phenotype())
    weights = []
    for (parent, child), (shared, _) in zip(TREE.edges, topology.shared, strict=True):
        weight = np.ones(len(shared))
        side, _, kind = TREE.names[child].partition("_")
        if kind in ("lower_leg", "lower_arm"):
            bones = ("UpLeg", "Leg", "Foot") if kind == "lower_leg" else ("Arm", "ForeArm", "Hand")
            before, joint, after = (rest.joints[body.bone_index(side.capitalize() + bone)] for bone in bones)
            points = rest.vertices[template.anny_vertex[topology.part_vertices[parent][shared]]]
            weight[(points - joint) @ (joint - (before + after) / 2) > 0] = STRETCHED_SIDE_WEIGHT
        weights.append(weight)
    return weights


def _learn_joints(
    body: AnnyBody, people: list[RestBody], poses: PoseSampler, template: Template, rng: np.random.Generator
) -> tuple[tuple[str, ...], Array, Array, dict[str, float]]:
    meshes, joints = [], []
    for person, pose in zip(people, poses.sample(rng, len(people)), strict=True):
        vertices, heads = body.pose(person, pose)
        meshes.append(vertices[template.anny_vertex])
        joints.append(body.locate_landmarks(vertices, heads))
    stacked = {name: np.stack([one[name] for one in joints]) for name in joints[0]}
    bodies, half = np.stack(meshes), len(meshes) // 2
    # Learn from one half of the people and measure on the other.
    names, index, weight = regress_joints(
        bodies[:half], {k: v[:half] for k, v in stacked.items()}, template.mirror_vertex
    )
    found = (weight[..., None] * bodies[half:, index]).sum(axis=2)
    error = {n: float(np.linalg.norm(found[:, j] - stacked[n][half:], axis=1).mean()) for j, n in enumerate(names)}
    return names, index, weight, error


def _pack_topology(template: Template) -> dict[str, Array]:
    return {
        "anny_vertex": template.anny_vertex.astype(np.int32),
        "faces": template.faces,
        "part_of_vertex": template.part_of_vertex,
        "part_of_face": template.part_of_face,
        "mirror_vertex": template.mirror_vertex.astype(np.int32),
    }


def _pack_spaces(
    topology: PartTopology, shape_space: MeshSpace, spaces: tuple[MeshSpace, ...], signs: tuple[Array, ...]
) -> dict[str, Array]:
    arrays: dict[str, Array] = {}
    start = 0
    for i, ids in enumerate(topology.part_vertices):
        rows = slice(start, start + len(ids))
        arrays[f"mean_shape_{i}"] = shape_space.mean[rows].astype(np.float32)
        arrays[f"shape_basis_{i}"] = shape_space.basis[rows].astype(np.float32)
        arrays[f"mean_pose_{i}"] = spaces[i].mean.astype(np.float32)
        arrays[f"pose_basis_{i}"] = spaces[i].basis.astype(np.float32)
        arrays[f"pose_mirror_{i}"] = signs[i].astype(np.int8)
        start += len(ids)
    return arrays


def _pack_edges(pairwise: list[Gaussian], stretch: list[Array]) -> dict[str, Array]:
    arrays: dict[str, Array] = {}
    for edge, (gaussian, weight) in enumerate(zip(pairwise, stretch, strict=True)):
        arrays[f"pair_mean_{edge}"] = gaussian.mean.astype(np.float32)
        arrays[f"pair_covariance_{edge}"] = gaussian.covariance.astype(np.float32)
        arrays[f"interface_weight_{edge}"] = weight.astype(np.float32)
    return arrays
