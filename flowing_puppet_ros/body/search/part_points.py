# SPDX-License-Identifier: Apache-2.0
"""The few points of the Stitched Puppet's parts by which the search judges particles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.cloud.mesh_geometry import farthest_points, vertex_normals
from flowing_puppet_ros.body.search.particles import Particles
from flowing_puppet_ros.model.sp import StitchedPuppet


@dataclass(frozen=True, slots=True, eq=False)
class PointSet:
    """Points of one part that move linearly with its coefficients.

    Attributes:
        mean: (K, 3) local frame, metres.
        pose_basis: (K, 3, D).
        shape_basis: (K, 3, S).
    """

    mean: np.ndarray
    pose_basis: np.ndarray
    shape_basis: np.ndarray

    @classmethod
    def of_part(cls, model: StitchedPuppet, part: int, rows: np.ndarray) -> PointSet:
        """Take the vertices `rows` (local indices) of a part (Eqs. 45 and 46)."""
        mean = model.mean_shape[part][rows] + model.mean_pose[part][rows]
        return cls(
            np.ascontiguousarray(mean, dtype=np.float64),
            np.ascontiguousarray(model.pose_basis[part][rows], dtype=np.float64),
            np.ascontiguousarray(model.shape_basis[part][rows], dtype=np.float64),
        )

    def blend(self, weight: np.ndarray, offset: np.ndarray) -> PointSet:
        """Return the weighted sums `weight` (M, K) of the points, moved by the constant `offset` (M, 3)."""
        return PointSet(
            np.tensordot(weight, self.mean, 1) + offset,
            np.tensordot(weight, self.pose_basis, 1),
            np.tensordot(weight, self.shape_basis, 1),
        )

    def __len__(self) -> int:
        return len(self.mean)

    def local(self, pose: np.ndarray, shape: np.ndarray) -> np.ndarray:
        """Points (P, K, 3) in the part's frame for coefficients (P, D) and (P, S)."""
        return self.shaped(shape) + (pose @ self.pose_basis.reshape(-1, pose.shape[1]).T).reshape(len(pose), -1, 3)

    def shaped(self, shape: np.ndarray) -> np.ndarray:
        """Points (P, K, 3) in the part's frame with intrinsic shape (P, S) and no pose deformation."""
        return self.mean + (shape @ self.shape_basis.reshape(-1, shape.shape[1]).T).reshape(len(shape), -1, 3)

    def world(self, particles: Particles) -> np.ndarray:
        """Points (P, K, 3) in the common frame (Eq. 47)."""
        local = self.local(particles.pose, particles.shape)
        return local @ particles.rotation.transpose(0, 2, 1) + particles.center[:, None, :]


@dataclass(frozen=True, slots=True, eq=False)
class PartPoints:
    """What the search knows of one part's surface.

    Attributes:
        surface: points spread evenly over the part; the first ones alone are spread evenly too.
        normals: (K, 3) outward normals of `surface` in the part's frame.
        interfaces: per edge at this part the interface points, in the edge's order.
        joints: the joints this part can place by itself, see `joint_index`.
        joint_index: (M,) indices into the model's joints.
    """

    surface: PointSet
    normals: np.ndarray
    interfaces: dict[int, PointSet]
    joints: PointSet
    joint_index: np.ndarray


def part_points(model: StitchedPuppet, surface_points: int = 120) -> tuple[PartPoints, ...]:
    """Choose the points of every part of a model; `surface_points` is their number a part."""
    normals = vertex_normals(model.vertices(model.rest_state()), model.faces)
    return tuple(_part_points(model, part, surface_points, normals) for part in range(len(model.tree)))


def _part_points(model: StitchedPuppet, part: int, count: int, normals: np.ndarray) -> PartPoints:
    rows = farthest_points(model.mean_shape[part] + model.mean_pose[part], count)
    interfaces = {}
    for edge, (parent, child) in enumerate(model.tree.edges):
        if part in (parent, child):
            interface = model.interfaces[edge]
            rows_at = interface.parent_index if part == parent else interface.child_index
            interfaces[edge] = PointSet.of_part(model, part, rows_at)
    joints, joint_index = _own_joints(model, part)
    return PartPoints(
        PointSet.of_part(model, part, rows),
        np.ascontiguousarray(normals[model.part_vertices[part][rows]]),
        interfaces,
        joints,
        joint_index,
    )


def _own_joints(model: StitchedPuppet, part: int) -> tuple[PointSet, np.ndarray]:
    """Joints of which at least two fifths of the regressor's weight lies in the part.

    The part's share of the regressor is scaled up to weight one; a constant offset in the part's frame makes the
    joint of the template exact.
    """
    local_row = np.full(len(model.part_of_vertex), -1)
    local_row[model.part_vertices[part]] = np.arange(len(model.part_vertices[part]))
    weight = np.zeros((len(model.joint_names), len(model.part_vertices[part])))
    for joint, (vertices, weights) in enumerate(zip(model.joint_index, model.joint_weight, strict=True)):
        inside = local_row[vertices] >= 0
        np.add.at(weight[joint], local_row[vertices][inside], weights[inside])
    share = weight.sum(axis=1)
    chosen = np.flatnonzero(share >= 0.4)
    weight = weight[chosen] / share[chosen, None]
    everything = PointSet.of_part(model, part, np.arange(weight.shape[1]))
    rest = model.rest_state()
    template = model.joints(model.vertices(rest))[chosen]
    target = (template - rest.center[part]) @ rest.rotation[part]
    local = model.local_vertices(part, rest.pose[part], rest.shape[part])
    return everything.blend(weight, target - weight @ local), chosen
