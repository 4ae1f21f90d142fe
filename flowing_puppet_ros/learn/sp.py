# SPDX-License-Identifier: Apache-2.0
"""Learn a Stitched Puppet from Anny bodies (thesis section "Learning" of the Stitched Puppet chapter)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.learn.anny import AnnyBody, RestBody
from flowing_puppet_ros.learn.pca import MIRROR, Space, mirrored_space, principal_space
from flowing_puppet_ros.learn.poses import PoseSampler
from flowing_puppet_ros.learn.sp_joints import regress_joints
from flowing_puppet_ros.learn.template import Template, make_template
from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.model.gaussian import Gaussian
from flowing_puppet_ros.model.sp import MIRROR_AXIS, PartTopology
from flowing_puppet_ros.model.tree import SP_PARENTS, PartTree
from flowing_puppet_ros.settings import Settings, setting

Array = np.ndarray[Any, Any]
Progress = Callable[[str], None]

TREE = PartTree.from_parents(SP_PARENTS)
POSE_COUNTS = {"torso": 12, "shoulder": 8, "upper_arm": 8}  # by the name without its side; all other parts have 5
OTHER_POSE_COUNT = 5
STRETCH = 0.8  # Eq. 48: weight of the front of the knee and the back of the elbow
LIMIT_TAIL, LIMIT_MARGIN = 0.001, np.radians(5.0)  # share of training poses beyond a joint limit; what is added to it
BORDER = 4.0  # how much more than the others the vertices that parts share count in the pose deformations
BATCH = 250


@dataclass(frozen=True, slots=True)
class LearnSettings(Settings):
    """How much a Stitched Puppet is learned from."""

    shapes: int = setting(600, "bodies of different shape", low=30, high=20000)
    poses: int = setting(4000, "poses of the average body", low=200, high=100000)
    shape_count: int = setting(10, "intrinsic shape coefficients", low=1, high=29)
    seed: int = setting(0, "seed of everything random", low=0, high=2**31 - 1)


@dataclass(frozen=True, slots=True, eq=False)
class PartPoses:
    """The training poses of the average body, part by part: rotations (n,16,3,3) and local deformations (n,N_i,3)."""

    rotations: Array
    deformations: tuple[Array, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
    """The arrays of a weights file and what the model card says about them."""

    arrays: dict[str, Array]
    shape_space: Space
    pose_spaces: tuple[Space, ...]
    joint_error: dict[str, float]


def learn(gender: str, settings: LearnSettings, mocap: Path | None, progress: Progress) -> Learned:
    """Learn the model of one gender. The template is the neutral one, so that all models correspond.

    InputError when the packages for learning or the motion capture cannot be used.
    """
    body, neutral = AnnyBody(gender), AnnyBody("neutral")
    rng = np.random.default_rng(settings.seed)
    poses = PoseSampler(body, mocap)
    progress("template mesh")
    template = make_template(neutral)
    topology = PartTopology.from_faces(template.faces, template.part_of_face, TREE)
    area = vertex_area(body.rest(body.mean_phenotype()).vertices[template.anny_vertex], template.faces)
    progress(f"{settings.shapes} shapes")
    people = [body.rest(body.sample_phenotype(rng)) for _ in range(settings.shapes)]
    shape_space, rest_center = _shape_space(people, template, topology, area, settings.shape_count)
    progress(f"{settings.poses} poses")
    posed = _pose_parts(body, template, topology, poses.sample(rng, settings.poses), area)
    progress("pose deformations of 16 parts")
    spaces, signs = _pose_spaces(posed, template, topology, area)
    pairwise, low, high = _pairwise(posed, spaces, signs, template, topology)
    progress("joints")
    names, joint_index, joint_weight, error = _joints(body, people, poses, template, rng)
    arrays = _arrays(template, topology, shape_space, spaces) | {
        "rest_center": rest_center.astype(np.float32),
        "limit_low": low.astype(np.float32),
        "limit_high": high.astype(np.float32),
        "joint_names": np.array(names),
        "joint_index": joint_index,
        "joint_weight": joint_weight.astype(np.float32),
    }
    for part, sign in enumerate(signs):
        arrays[f"pose_mirror_{part}"] = sign.astype(np.int8)
    for edge, (gaussian, weight) in enumerate(zip(pairwise, _interface_weights(body, template, topology), strict=True)):
        arrays[f"pair_mean_{edge}"] = gaussian.mean.astype(np.float32)
        arrays[f"pair_covariance_{edge}"] = gaussian.covariance.astype(np.float32)
        arrays[f"interface_weight_{edge}"] = weight.astype(np.float32)
    return Learned(arrays, shape_space, spaces, error)


def vertex_area(vertices: Array, faces: Array) -> Array:
    """A third of the area (V,) in square metres of the faces (F,3) about each vertex (V,3)."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    return np.asarray(np.bincount(faces.ravel(), np.repeat(area, 3), minlength=len(vertices)))


def local_mirror(template: Template, topology: PartTopology, part: int) -> Array:
    """For every vertex (N_i,) of a part the local index of its mirror image in the part on the other side."""
    return np.searchsorted(
        topology.part_vertices[TREE.mirror[part]], template.mirror_vertex[topology.part_vertices[part]]
    )


def _shape_space(
    people: list[RestBody], template: Template, topology: PartTopology, area: Array, count: int
) -> tuple[Space, Array]:
    # One space over the stacked parts, each relative to its own centre (thesis section 2).
    bodies = np.stack([person.vertices[template.anny_vertex] for person in people])
    centres = np.stack([bodies[:, ids].mean(axis=1) for ids in topology.part_vertices], axis=1)
    stacked = np.concatenate([bodies[:, ids] - centres[:, [i]] for i, ids in enumerate(topology.part_vertices)], axis=1)
    weight = np.concatenate([area[ids] for ids in topology.part_vertices])
    space = principal_space(stacked, weight, count)
    starts = np.cumsum([0, *map(len, topology.part_vertices)])
    across = np.concatenate([starts[TREE.mirror[i]] + local_mirror(template, topology, i) for i in range(len(TREE))])
    mean = (space.mean + space.mean[across] * MIRROR) / 2
    basis = (space.basis + space.basis[across] * MIRROR[:, None]) / 2
    centre = centres.mean(axis=0)
    centre = (centre + centre[list(TREE.mirror)] * MIRROR) / 2
    return Space(mean, basis, weight, space.share, space.residual), centre


def _pose_parts(body: AnnyBody, template: Template, topology: PartTopology, rotations: Array, area: Array) -> PartPoses:
    rest = body.rest(body.mean_phenotype())
    own = [rest.vertices[template.anny_vertex[ids]] for ids in topology.part_vertices]
    own = [points - points.mean(axis=0) for points in own]
    turned, moved = np.empty((len(rotations), len(TREE), 3, 3)), []
    deformations = [np.empty((len(rotations), *points.shape), np.float32) for points in own]
    for start in range(0, len(rotations), BATCH):
        rows = slice(start, start + BATCH)
        meshes = body.pose(rest, rotations[rows], template.anny_vertex)[0]
        for i, ids in enumerate(topology.part_vertices):
            moved = meshes[:, ids]
            turned[rows, i], shift = rotation.procrustes(own[i], moved, area[ids])
            deformations[i][rows] = (moved - shift[:, None]) @ turned[rows, i] - own[i]
    return PartPoses(turned, tuple(deformations))


def _pose_count(part: int) -> int:
    return POSE_COUNTS.get(TREE.names[part].removeprefix("left_").removeprefix("right_"), OTHER_POSE_COUNT)


def _pose_spaces(
    posed: PartPoses, template: Template, topology: PartTopology, area: Array
) -> tuple[tuple[Space, ...], tuple[Array, ...]]:
    # A left part learns from itself and the mirrored right one; the right part's space is the left one's mirror image.
    copies = np.bincount(np.concatenate(topology.part_vertices), minlength=len(area))
    weighted = area * np.where(copies > 1, BORDER, 1.0)
    spaces: list[Any] = [None] * len(TREE)
    signs = [np.ones(_pose_count(i)) for i in range(len(TREE))]
    for i, other in enumerate(TREE.mirror):
        across, weight = local_mirror(template, topology, i), weighted[topology.part_vertices[i]]
        own = posed.deformations[i].astype(np.float64)
        if other == i:
            spaces[i], signs[i] = mirrored_space(own, across, weight, _pose_count(i))
        elif TREE.names[i].startswith("left_"):
            images = posed.deformations[other][:, across] * MIRROR
            space = principal_space(np.concatenate([own, images]), weight, _pose_count(i))
            back = local_mirror(template, topology, other)
            mirrored_mean, mirrored_basis = space.mean[back] * MIRROR, space.basis[back] * MIRROR[:, None]
            spaces[i] = space
            spaces[other] = Space(mirrored_mean, mirrored_basis, weight[back], space.share, space.residual)
    return tuple(spaces), tuple(signs)


def _pairwise(
    posed: PartPoses, spaces: tuple[Space, ...], signs: tuple[Array, ...], template: Template, topology: PartTopology
) -> tuple[list[Gaussian], Array, Array]:
    """Eq. 49 and joint limits of every edge, each from its own samples and the mirror image of the other side's."""
    d = [spaces[i].project(posed.deformations[i]) for i in range(len(TREE))]
    samples = []
    for parent, child in TREE.edges:
        relative = np.swapaxes(posed.rotations[:, parent], -1, -2) @ posed.rotations[:, child]
        samples.append(np.concatenate([rotation.log(relative), d[parent], d[child]], axis=1))
    gaussians, low, high = [], np.empty((len(samples), 3)), np.empty((len(samples), 3))
    for edge, (parent, child) in enumerate(TREE.edges):
        flip = np.concatenate([MIRROR_AXIS, signs[parent], signs[child]])
        both = np.concatenate([samples[edge], samples[TREE.mirror[child] - 1] * flip])
        gaussians.append(Gaussian.from_samples(both, ridge=1e-6))
        low[edge], high[edge] = np.quantile(both[:, :3], [LIMIT_TAIL, 1 - LIMIT_TAIL], axis=0)
    return gaussians, low - LIMIT_MARGIN, high + LIMIT_MARGIN


def _interface_weights(body: AnnyBody, template: Template, topology: PartTopology) -> list[Array]:
    rest = body.rest(body.mean_phenotype())
    weights = []
    for (parent, child), (shared, _) in zip(TREE.edges, topology.shared, strict=True):
        weight = np.ones(len(shared))
        side, _, kind = TREE.names[child].partition("_")
        if kind in ("lower_leg", "lower_arm"):
            bones = ("UpLeg", "Leg", "Foot") if kind == "lower_leg" else ("Arm", "ForeArm", "Hand")
            before, joint, after = (rest.joints[body.bone(side.capitalize() + bone)] for bone in bones)
            points = rest.vertices[template.anny_vertex[topology.part_vertices[parent][shared]]]
            weight[(points - joint) @ (joint - (before + after) / 2) > 0] = STRETCH
        weights.append(weight)
    return weights


def _joints(
    body: AnnyBody, people: list[RestBody], poses: PoseSampler, template: Template, rng: np.random.Generator
) -> tuple[tuple[str, ...], Array, Array, dict[str, float]]:
    meshes, joints = [], []
    for person, pose in zip(people, poses.sample(rng, len(people)), strict=True):
        vertices, heads = body.pose(person, pose)
        meshes.append(vertices[template.anny_vertex])
        joints.append(body.landmarks(vertices, heads))
    stacked = {name: np.stack([one[name] for one in joints]) for name in joints[0]}
    bodies, half = np.stack(meshes), len(meshes) // 2
    # Learned on one half of the people and measured on the other.
    names, index, weight = regress_joints(
        bodies[:half], {k: v[:half] for k, v in stacked.items()}, template.mirror_vertex
    )
    found = (weight[..., None] * bodies[half:, index]).sum(axis=2)
    error = {n: float(np.linalg.norm(found[:, j] - stacked[n][half:], axis=1).mean()) for j, n in enumerate(names)}
    return names, index, weight, error


def _arrays(
    template: Template, topology: PartTopology, shape_space: Space, spaces: tuple[Space, ...]
) -> dict[str, Array]:
    arrays: dict[str, Array] = {
        "faces": template.faces,
        "part_of_vertex": template.part_of_vertex,
        "part_of_face": template.part_of_face,
        "mirror_vertex": template.mirror_vertex.astype(np.int32),
    }
    start = 0
    for i, ids in enumerate(topology.part_vertices):
        rows = slice(start, start + len(ids))
        arrays[f"mean_shape_{i}"] = shape_space.mean[rows].astype(np.float32)
        arrays[f"shape_basis_{i}"] = shape_space.basis[rows].astype(np.float32)
        arrays[f"mean_pose_{i}"] = spaces[i].mean.astype(np.float32)
        arrays[f"pose_basis_{i}"] = spaces[i].basis.astype(np.float32)
        start += len(ids)
    return arrays
