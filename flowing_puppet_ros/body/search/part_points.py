# SPDX-License-Identifier: Apache-2.0
"""The few points of the Stitched Puppet's parts by which the search scores particles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.cloud.mesh_geometry import farthest_points, vertex_normals
from flowing_puppet_ros.body.search.particles import Particles
from flowing_puppet_ros.model.sp import StitchedPuppet

MIN_OWN_SHARE = 0.4  # of a joint's regressor weight, for a part that determines the joint alone


@dataclass(frozen=True, slots=True, eq=False)
class PointSet:
    """Points of one part that move linearly with its coefficients.

    Attributes:
        mean: (K, 3) metres in the part's frame.
        pose_basis: (K, 3, D).
        shape_basis: (K, 3, S).
    """

    mean: np.ndarray
    pose_basis: np.ndarray
    shape_basis: np.ndarray

    @classmethod
    def of_part(cls, model: StitchedPuppet, part: int, rows: np.ndarray) -> PointSet:
        """Take the vertices `rows` (K,), local indices of a part (Eqs. 45 and 46)."""
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

    def deform(self, pose: np.ndarray, shape: np.ndarray) -> np.ndarray:
        """Return points (P, K, 3) in the part's frame for coefficients (P, D) and (P, S), metres."""
        return self.apply_shape(shape) + (pose @ self.pose_basis.reshape(-1, pose.shape[1]).T).reshape(len(pose), -1, 3)

    def apply_shape(self, shape: np.ndarray) -> np.ndarray:
        """Return points (P, K, 3) in the part's frame with intrinsic shape (P, S) and no pose deformation."""
        return self.mean + (shape @ self.shape_basis.reshape(-1, shape.shape[1]).T).reshape(len(shape), -1, 3)

    def to_world(self, particles: Particles) -> np.ndarray:
        """Return points (P, K, 3) of particles in the common frame (Eq. 47), metres."""
        local = self.deform(particles.pose, particles.shape)
        return local @ particles.rotation.transpose(0, 2, 1) + particles.center[:, None, :]


@dataclass(frozen=True, slots=True, eq=False)
class PartPoints:
    """The points of one part that the search uses.

    Attributes:
        surface: points spread evenly over the part, as any number of the first ones is.
        rows: (K,) local indices of `surface` among the part's vertices.
        normals: (K, 3) outward normals of `surface` in the part's frame.
        interfaces: for each edge at this part the interface points, in the edge's order.
        joints: joints whose position this part determines alone.
        joint_index: (M,) indices of `joints` among the model's.
    """

    surface: PointSet
    rows: np.ndarray
    normals: np.ndarray
    interfaces: dict[int, PointSet]
    joints: PointSet
    joint_index: np.ndarray


def build_part_points(model: StitchedPuppet, surface_points: int = 120) -> tuple[PartPoints, ...]:
    """Choose the points of every part of a model, `surface_points` on the surface of each."""
    normals = vertex_normals(model.vertices(model.rest_state()), model.faces)
    return tuple(_build_part(model, part, surface_points, normals) for part in range(len(model.tree)))


def _build_part(model: StitchedPuppet, part: int, count: int, normals: np.ndarray) -> PartPoints:
    rows = farthest_points(model.mean_shape[part] + model.mean_pose[part], count)
    interfaces = {}
    for edge, (parent, child) in enumerate(model.tree.edges):
        if part in (parent, child):
            interface = model.interfaces[edge]
            rows_at = interface.parent_index if part == parent else interface.child_index
            interfaces[edge] = PointSet.of_part(model, part, rows_at)
    joints, joint_index = _find_own_joints(model, part)
    return PartPoints(
        PointSet.of_part(model, part, rows),
        rows,
        np.ascontiguousarray(normals[model.part_vertices[part][rows]]),
        interfaces,
        joints,
        joint_index,
    )


def _find_own_joints(model: StitchedPuppet, part: int) -> tuple[PointSet, np.ndarray]:
    """Find the joints of which at least `MIN_OWN_SHARE` of the regressor's weight lies in the part.

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
    chosen = np.flatnonzero(share >= MIN_OWN_SHARE)
    weight = weight[chosen] / share[chosen, None]
    everything = PointSet.of_part(model, part, np.arange(weight.shape[1]))
    rest = model.rest_state()
    template = model.joints(model.vertices(rest))[chosen]
    target = (template - rest.center[part]) @ rest.rotation[part]
    local = model.local_vertices(part, rest.pose[part], rest.shape[part])
    return everything.blend(weight, target - weight @ local), chosen
