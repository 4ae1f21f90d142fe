# SPDX-License-Identifier: Apache-2.0
"""Pose-dependent deformations of the Stitched Puppet's parts, and what the poses of neighbours say of each other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.learn.anny.body import AnnyBody, RestBody
from flowing_puppet_ros.learn.sp.fingers import Fingers
from flowing_puppet_ros.learn.sp.pca import MIRROR, Space, mirrored_space, principal_space
from flowing_puppet_ros.learn.sp.template import Template
from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.model.gaussian import Gaussian
from flowing_puppet_ros.model.sp import MIRROR_AXIS, PartTopology
from flowing_puppet_ros.model.tree import SP_PARENTS, PartTree

TREE = PartTree.from_parents(SP_PARENTS)
# By the name without its side; all other parts have OTHER_POSE_COUNT.
POSE_COUNTS = {"torso": 12, "shoulder": 8, "upper_arm": 8, "hand": 12}
OTHER_POSE_COUNT = 5
LIMIT_TAIL, LIMIT_MARGIN = 0.001, np.radians(5.0)  # share of training poses beyond a joint limit; what is added to it
BORDER = 4.0  # how much more than the others the vertices that parts share count in the pose deformations
BATCH = 250
RIDGE = 1e-6  # added to the variances of Eq. 49


@dataclass(frozen=True, slots=True, eq=False)
class PartPoses:
    """The training poses of the average body, part by part: rotations (n,16,3,3) and local deformations (n,N_i,3)."""

    rotations: Array
    deformations: tuple[Array, ...]


def local_mirror(template: Template, topology: PartTopology, part: int) -> Array:
    """For every vertex (N_i,) of a part the local index of its mirror image in the part on the other side."""
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
    """Pose the average body by bone rotations (n,B,3,3) and take every part back to its own frame by Procrustes.

    The fingers close at random, mostly instead of by the rotations. A hand's frame is that of its palm.
    """
    rest, fingers = body.rest(body.mean_phenotype()), Fingers(body)
    own = [rest.vertices[template.anny_vertex[ids]] for ids in topology.part_vertices]
    own = [points - points.mean(axis=0) for points in own]
    still = 1.0 - fingers.share[template.anny_vertex]
    turned = np.empty((len(rotations), len(TREE), 3, 3))
    deformations = [np.empty((len(rotations), *points.shape), np.float32) for points in own]
    rotations = rotations.copy()
    angles = fingers.close(hands, rotations)
    for start in range(0, len(rotations), BATCH):
        rows = slice(start, start + BATCH)
        closed = RestBody(fingers.bodies(angles[rows]), rest.joints)
        meshes = body.pose(closed, rotations[rows], template.anny_vertex)[0]
        for i, ids in enumerate(topology.part_vertices):
            moved = meshes[:, ids]
            turned[rows, i], shift = rotation.procrustes(own[i], moved, area[ids] * still[ids])
            deformations[i][rows] = (moved - shift[:, None]) @ turned[rows, i] - own[i]
    return PartPoses(turned, tuple(deformations))


def _pose_count(part: int) -> int:
    return POSE_COUNTS.get(TREE.names[part].removeprefix("left_").removeprefix("right_"), OTHER_POSE_COUNT)


def pose_spaces(
    posed: PartPoses, template: Template, topology: PartTopology, area: Array
) -> tuple[tuple[Space, ...], tuple[Array, ...]]:
    """The pose space of every part, and the signs (P_i,) its coefficients get in a mirror.

    A left part learns from itself and the mirrored right one; the right part's space is the left one's mirror image.
    """
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


def learn_pairwise(
    posed: PartPoses, spaces: tuple[Space, ...], signs: tuple[Array, ...]
) -> tuple[list[Gaussian], Array, Array]:
    """Eq. 49 and the joint limits (15,3) of every edge, from its own samples and the mirror image of the other side's.

    The right side's are the mirror images of the left side's.
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
