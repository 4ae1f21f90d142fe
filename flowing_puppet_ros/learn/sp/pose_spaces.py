# SPDX-License-Identifier: Apache-2.0
"""Pose-dependent deformations of the Stitched Puppet's parts, and the pairwise Gaussians of neighbours' poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.learn.anny.body import AnnyBody, RestBody
from flowing_puppet_ros.learn.sp.fingers import Fingers
from flowing_puppet_ros.learn.sp.pca import MIRROR, MeshSpace, fit_mirrored_space, fit_space
from flowing_puppet_ros.learn.sp.template import Template
from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.model.gaussian import Gaussian
from flowing_puppet_ros.model.sp import MIRROR_AXIS, PartTopology
from flowing_puppet_ros.model.tree import SP_PARENTS, PartTree

TREE = PartTree.from_parents(SP_PARENTS)
# Pose coefficients of a part, by its name without the side; all other parts have OTHER_POSE_COUNT.
POSE_COUNTS = {"torso": 12, "shoulder": 8, "upper_arm": 8, "hand": 12}
OTHER_POSE_COUNT = 5
LIMIT_TAIL = 0.001  # quantile of the training poses at a joint limit
LIMIT_MARGIN = np.radians(5.0)  # added to a joint limit
BORDER_WEIGHT = 4.0  # weight of vertices that parts share, relative to the others
BATCH_SIZE = 250  # poses at a time
RIDGE = 1e-6  # added to the variances of Eq. 49


@dataclass(frozen=True, slots=True, eq=False)
class PartPoses:
    """Training poses of the average body: part rotations (n, 16, 3, 3) and, per part, deformations (n, N_i, 3) m."""

    rotations: Array
    deformations: tuple[Array, ...]


def index_mirror_vertices(template: Template, topology: PartTopology, part: int) -> Array:
    """Return, for the vertices of a part, the local indices (N_i,) of their mirror images in the mirrored part."""
    return np.searchsorted(
        topology.part_vertices[TREE.mirror[part]], template.mirror_vertex[topology.part_vertices[part]]
    )


def pose_parts(
    body: AnnyBody,
    template: Template,
    topology: PartTopology,
    rotations: Array,
    area: Array,
    hands: np.random.Generator,
) -> PartPoses:
    """Pose the average body by bone rotations (n, B, 3, 3) and align every part to its rest frame by Procrustes.

    Most hands close at random instead of following the rotations. A hand's frame is that of its palm.
    """
    rest, fingers = body.make_rest_body(body.mean_phenotype()), Fingers(body)
    local = [rest.vertices[template.anny_vertex[ids]] for ids in topology.part_vertices]
    local = [points - points.mean(axis=0) for points in local]
    palm_share = 1.0 - fingers.share[template.anny_vertex]
    part_rotations = np.empty((len(rotations), len(TREE), 3, 3))
    deformations = [np.empty((len(rotations), *points.shape), np.float32) for points in local]
    rotations = rotations.copy()
    angles = fingers.replace_finger_bends(hands, rotations)
    for start in range(0, len(rotations), BATCH_SIZE):
        rows = slice(start, start + BATCH_SIZE)
        closed = RestBody(fingers.deform_body(angles[rows]), rest.joints)
        meshes = body.pose(closed, rotations[rows], template.anny_vertex)[0]
        for i, ids in enumerate(topology.part_vertices):
            moved = meshes[:, ids]
            part_rotations[rows, i], shift = rotation.procrustes(local[i], moved, area[ids] * palm_share[ids])
            deformations[i][rows] = (moved - shift[:, None]) @ part_rotations[rows, i] - local[i]
    return PartPoses(part_rotations, tuple(deformations))


def _pose_count(part: int) -> int:
    return POSE_COUNTS.get(TREE.names[part].removeprefix("left_").removeprefix("right_"), OTHER_POSE_COUNT)


def fit_pose_spaces(
    posed: PartPoses, template: Template, topology: PartTopology, area: Array
) -> tuple[tuple[MeshSpace, ...], tuple[Array, ...]]:
    """Fit the pose space of every part; also return the signs (P_i,) that its coefficients get in a mirror.

    A left part learns from itself and the mirrored right part; the right part's space is the left part's mirror image.
    """
    copies = np.bincount(np.concatenate(topology.part_vertices), minlength=len(area))
    weighted = area * np.where(copies > 1, BORDER_WEIGHT, 1.0)
    spaces: list[Any] = [None] * len(TREE)
    signs = [np.ones(_pose_count(i)) for i in range(len(TREE))]
    for i, other in enumerate(TREE.mirror):
        across, weight = index_mirror_vertices(template, topology, i), weighted[topology.part_vertices[i]]
        own = posed.deformations[i].astype(np.float64)
        if other == i:
            spaces[i], signs[i] = fit_mirrored_space(own, across, weight, _pose_count(i))
        elif TREE.names[i].startswith("left_"):
            images = posed.deformations[other][:, across] * MIRROR
            space = fit_space(np.concatenate([own, images]), weight, _pose_count(i))
            back = index_mirror_vertices(template, topology, other)
            mirrored_mean, mirrored_basis = space.mean[back] * MIRROR, space.basis[back] * MIRROR[:, None]
            spaces[i] = space
            spaces[other] = MeshSpace(mirrored_mean, mirrored_basis, weight[back], space.share, space.residual)
    return tuple(spaces), tuple(signs)


def learn_pairwise(
    posed: PartPoses, spaces: tuple[MeshSpace, ...], signs: tuple[Array, ...]
) -> tuple[list[Gaussian], Array, Array]:
    """Fit the Gaussian of Eq. 49 and minimum and maximum joint limits (15, 3) rad of every edge.

    An edge learns from its own samples and the mirrored samples of the other side; the right side mirrors the left.
    """
    d = [space.project(deformed) for space, deformed in zip(spaces, posed.deformations, strict=True)]
    samples = []
    for parent, child in TREE.edges:
        relative = np.swapaxes(posed.rotations[:, parent], -1, -2) @ posed.rotations[:, child]
        samples.append(np.concatenate([rotation.log(relative), d[parent], d[child]], axis=1))
    gaussians: list[Any] = [None] * len(samples)
    low, high = np.empty((len(samples), 3)), np.empty((len(samples), 3))
    for edge, (parent, child) in enumerate(TREE.edges):
        if TREE.names[child].startswith("right_"):
            continue
        flip, other = np.concatenate([MIRROR_AXIS, signs[parent], signs[child]]), TREE.mirror[child] - 1
        both = np.concatenate([samples[edge], samples[other] * flip])
        own = Gaussian.from_samples(both, ridge=RIDGE)
        gaussians[other] = Gaussian(own.mean * flip, own.covariance * flip * flip[:, None])
        gaussians[edge] = own
        extremes = np.quantile(both[:, :3], [LIMIT_TAIL, 1 - LIMIT_TAIL], axis=0)
        low[other], high[other] = np.sort(extremes * MIRROR_AXIS, axis=0)
        low[edge], high[edge] = extremes
    return gaussians, low - LIMIT_MARGIN, high + LIMIT_MARGIN
