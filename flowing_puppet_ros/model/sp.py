# SPDX-License-Identifier: Apache-2.0
"""The Stitched Puppet: a part-based 3D body model with PCA shape and pose deformations (thesis chapter of that name).

Metres; x forward, y to the person's left, z up (REP-103), origin between the hips of the template.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.model import rotation, weights
from flowing_puppet_ros.model.gaussian import Gaussian
from flowing_puppet_ros.model.posing import BodyPoints, PosedPoints
from flowing_puppet_ros.model.tree import SP_PARENTS, PartTree

POSE_WIDTH = 12  # columns of BodyState.pose; parts with fewer coefficients leave the rest 0
MAX_DEVIATIONS = 3.0  # samples stay within this many standard deviations of every coefficient
MIRROR_POINT = np.array([1.0, -1.0, 1.0])  # signs of a point mirrored in the plane y = 0 ...
MIRROR_AXIS = np.array([-1.0, 1.0, -1.0])  # ... and of a rotation vector


@dataclass(frozen=True, slots=True, eq=False)
class BodyState:
    """The node variables of all 16 parts (Eq. 44), with any leading batch dimensions.

    `center` (..., 16, 3) m, `rotation` (..., 16, 3, 3), `pose` (..., 16, 12) zero-padded and `shape` (..., 16, S), both
    in standard deviations.
    """

    center: Array
    rotation: Array
    pose: Array
    shape: Array


@dataclass(frozen=True, slots=True, eq=False)
class Interface:
    """Points that a parent part and a child part share (Eq. 48): local indices (K,) in each and `weight` (K,)."""

    parent_index: Array
    child_index: Array
    weight: Array


@dataclass(frozen=True, slots=True, eq=False)
class PartTopology:
    """Partition of the template into parts, each with its own copy of the vertices on its border."""

    part_vertices: tuple[Array, ...]
    part_faces: tuple[Array, ...]
    shared: tuple[tuple[Array, Array], ...]

    @classmethod
    def from_faces(cls, faces: Array, part_of_face: Array, tree: PartTree) -> PartTopology:
        """Split template `faces` (F, 3) by `part_of_face` (F,); `shared` has the local indices of every edge."""
        vertices = tuple(np.unique(faces[part_of_face == i]).astype(np.int32) for i in range(len(tree)))
        local = tuple(np.searchsorted(vertices[i], faces[part_of_face == i]).astype(np.int32) for i in range(len(tree)))
        shared = []
        for parent, child in tree.edges:
            _, first, second = np.intersect1d(vertices[parent], vertices[child], return_indices=True)
            shared.append((first.astype(np.int32), second.astype(np.int32)))
        return cls(vertices, local, tuple(shared))


@dataclass(frozen=True, slots=True, eq=False)
class StitchedPuppet:
    """A learned Stitched Puppet: V vertices, S shape coefficients; part i has N_i vertices and P_i pose coefficients.

    `faces` (F, 3) are closed, counter-clockwise from outside. `part_vertices` are template ids; border vertices are in
    both parts. `mean_shape`, `shape_basis` (N_i, 3, S), `mean_pose` and `pose_basis` (N_i, 3, P_i) are those of
    Eqs. 45 and 46, in the part's frame (origin in its rest centre, axes of the body). `pairwise` is Eq. 49 over
    [r_ij (3), d_i, d_j] with r_ij = log(R_i^T R_j); `limit_low` and `limit_high` (15, 3) rad bound r_ij.
    `joint_index` and `joint_weight` (J, M) give joints as convex sums of vertices. `mirror_vertex` (V,) and the signs
    `pose_mirror` (P_i,) describe the same body seen in a mirror.
    """

    name: str
    tree: PartTree
    faces: Array
    part_of_vertex: Array
    part_vertices: tuple[Array, ...]
    part_faces: tuple[Array, ...]
    mean_shape: tuple[Array, ...]
    shape_basis: tuple[Array, ...]
    mean_pose: tuple[Array, ...]
    pose_basis: tuple[Array, ...]
    rest_center: Array
    interfaces: tuple[Interface, ...]
    pairwise: tuple[Gaussian, ...]
    limit_low: Array
    limit_high: Array
    joint_names: tuple[str, ...]
    joint_index: Array
    joint_weight: Array
    mirror_vertex: Array
    pose_mirror: tuple[Array, ...]

    @classmethod
    def load(cls, name: str = "neutral") -> StitchedPuppet:
        """Return the shipped model "neutral", "female" or "male"; InputError for another name."""
        return _load_shared(name)

    @classmethod
    def from_arrays(cls, name: str, arrays: Mapping[str, Array]) -> StitchedPuppet:
        """Build from the arrays of a weights file, as `learn.sp.training` writes them."""
        tree = PartTree.from_parents(SP_PARENTS)
        topology = PartTopology.from_faces(arrays["faces"], arrays["part_of_face"], tree)
        joint_weight = arrays["joint_weight"].astype(np.float64)
        parts, edges = range(len(tree)), range(len(tree) - 1)
        return cls(
            name=name,
            tree=tree,
            faces=arrays["faces"],
            part_of_vertex=arrays["part_of_vertex"],
            part_vertices=topology.part_vertices,
            part_faces=topology.part_faces,
            mean_shape=tuple(arrays[f"mean_shape_{i}"].astype(np.float64) for i in parts),
            shape_basis=tuple(arrays[f"shape_basis_{i}"].astype(np.float64) for i in parts),
            mean_pose=tuple(arrays[f"mean_pose_{i}"].astype(np.float64) for i in parts),
            pose_basis=tuple(arrays[f"pose_basis_{i}"].astype(np.float64) for i in parts),
            rest_center=arrays["rest_center"].astype(np.float64),
            interfaces=tuple(
                Interface(*topology.shared[e], arrays[f"interface_weight_{e}"].astype(np.float64)) for e in edges
            ),
            pairwise=tuple(Gaussian(arrays[f"pair_mean_{e}"], arrays[f"pair_covariance_{e}"]) for e in edges),
            limit_low=arrays["limit_low"].astype(np.float64),
            limit_high=arrays["limit_high"].astype(np.float64),
            joint_names=tuple(str(joint) for joint in arrays["joint_names"]),
            joint_index=arrays["joint_index"],
            # Rounded weights miss a sum of 1 by enough to move joints that are far from the origin.
            joint_weight=joint_weight / joint_weight.sum(axis=1, keepdims=True),
            mirror_vertex=arrays["mirror_vertex"],
            pose_mirror=tuple(arrays[f"pose_mirror_{i}"].astype(np.float64) for i in parts),
        )

    @property
    def shape_count(self) -> int:
        """S, the number of intrinsic shape coefficients."""
        return int(self.shape_basis[0].shape[2])

    def pose_count(self, part: int) -> int:
        """Return P_i, the number of pose coefficients of a part."""
        return int(self.pose_basis[part].shape[2])

    def rest_state(self, shape: Array | None = None) -> BodyState:
        """Return a body in the template pose: pose coefficients that undo the mean pose deformation.

        `shape` (16, S) are its shape coefficients, to which the parts are stitched; None: the average body.
        """
        rest = _fit_rest_pose(self)
        parts = len(self.tree)
        upright = np.broadcast_to(np.eye(3), (parts, 3, 3)).copy()
        state = BodyState(self.rest_center.copy(), upright, rest.copy(), np.zeros((parts, self.shape_count)))
        if shape is None:
            return state
        state.shape[:] = shape
        change = [basis @ own for basis, own in zip(self.shape_basis, state.shape, strict=True)]
        for (parent, child), interface in zip(self.tree.edges, self.interfaces, strict=True):
            apart = change[parent][interface.parent_index] - change[child][interface.child_index]
            moved = (
                np.average(apart, axis=0, weights=interface.weight) + state.center[parent] - self.rest_center[parent]
            )
            state.center[child] += moved
        return state

    def measure_height(self, shape: Array) -> float:
        """Return the height in metres of the person of a `shape` (16, S), standing in the template pose."""
        mean, change = _measure_rest_heights(self)
        return float(np.ptp(mean + change @ np.ravel(shape)))

    def local_vertices(self, i: int, d: Array, s: Array) -> Array:
        """Return the vertices (..., N_i, 3) of part `i` in its own frame (Eqs. 45 and 46).

        `d` (..., P_i or zero-padded) are pose coefficients, `s` (..., S) shape coefficients.
        """
        mean, count = self.mean_shape[i] + self.mean_pose[i], self.pose_count(i)
        shaped = s @ self.shape_basis[i].reshape((-1, self.shape_count)).T
        posed = d[..., :count] @ self.pose_basis[i].reshape((-1, count)).T
        return np.asarray((shaped + posed).reshape((*shaped.shape[:-1], -1, 3)) + mean)

    def part_mesh(self, i: int, o: Array, r: Array, d: Array, s: Array) -> Array:
        """Return the vertices (..., N_i, 3) of part `i` in the world (Eq. 47).

        `o` (..., 3) is its centre, `r` (..., 3, 3) its rotation, `d` and `s` as in `local_vertices`.
        """
        return np.asarray(self.local_vertices(i, d, s) @ np.swapaxes(r, -1, -2) + np.asarray(o)[..., None, :])

    def parts(self, state: BodyState) -> tuple[Array, ...]:
        """Return the vertices (..., N_i, 3) of every part in the world."""
        return tuple(
            self.part_mesh(
                i, state.center[..., i, :], state.rotation[..., i, :, :], state.pose[..., i, :], state.shape[..., i, :]
            )
            for i in range(len(self.tree))
        )

    def vertices(self, state: BodyState) -> Array:
        """Return the vertices (..., V, 3) of the whole body; where parts share a vertex, the mean of their copies."""
        if state.center.ndim == 2:
            return pose_points(self, state).vertices
        total = np.zeros((*state.center.shape[:-2], len(self.part_of_vertex), 3))
        copies = np.zeros(len(self.part_of_vertex))
        for ids, mesh in zip(self.part_vertices, self.parts(state), strict=True):
            total[..., ids, :] += mesh
            copies[ids] += 1
        return np.asarray(total / copies[:, None])

    def joints(self, vertices: Array) -> Array:
        """Return the joints (..., J, 3), in the order of `joint_names`, of body `vertices` (..., V, 3)."""
        return np.asarray((self.joint_weight[..., None] * vertices[..., self.joint_index, :]).sum(axis=-2))

    def stitch(self, child: int, parent: int, parent_points: Array, d: Array, s: Array) -> tuple[Array, Array]:
        """Return the rotation (..., 3, 3) and centre (..., 3) that fit the child's interface to its parent's.

        `parent_points` (..., K, 3) are the parent's interface points in the world, in the order of the interface.
        """
        if self.tree.parents[child] != parent:
            raise ValueError(f"{self.tree.names[parent]} is not the parent of {self.tree.names[child]}")
        interface = self.interfaces[child - 1]
        points = self.local_vertices(child, d, s)[..., interface.child_index, :]
        return rotation.procrustes(points, parent_points, interface.weight)

    def sample(self, rng: np.random.Generator, shape_scale: float = 1.0, pose_scale: float = 1.0) -> BodyState:
        """Draw one of the bodies of `sample_many`."""
        bodies = self.sample_many(rng, 1, shape_scale, pose_scale)
        return BodyState(bodies.center[0], bodies.rotation[0], bodies.pose[0], bodies.shape[0])

    def sample_many(
        self, rng: np.random.Generator, count: int, shape_scale: float = 1.0, pose_scale: float = 1.0
    ) -> BodyState:
        """Draw `count` stitched bodies that face along x (thesis section "Generating Model Instances").

        All parts of a body share one shape. From the torso outwards, a part's pose coefficients are drawn given its
        parent's, and its rotation and centre stitch it to its parent within the joint limits. The scales multiply
        standard deviations. Bodies drawn one by one are the same but for rounding.
        """
        counts = [self.pose_count(part) for part in range(len(self.tree))]
        ends = np.cumsum([self.shape_count, *counts])
        drawn = np.split(rng.standard_normal((count, ends[-1])), ends[:-1], axis=1)
        rest = self.rest_state()
        bodies = BodyState(*(np.tile(array, (count, *[1] * array.ndim)) for array in _arrays_of(rest)))
        bodies.shape[:] = np.clip(shape_scale * drawn[0], -MAX_DEVIATIONS, MAX_DEVIATIONS)[:, None, :]
        bodies.pose[:, 0, : counts[0]] = np.clip(pose_scale * drawn[1], -MAX_DEVIATIONS, MAX_DEVIATIONS)
        for parent, child in self.tree.edges:
            given, own = counts[parent], counts[child]
            mean, gain, axes = self.pairwise[child - 1].make_conditional(
                np.arange(3 + given, 3 + given + own), np.arange(3, 3 + given)
            )
            expected = mean + bodies.pose[:, parent, :given] @ gain.T
            poses = expected + pose_scale * (drawn[1 + child] @ axes.T)
            bodies.pose[:, child, :own] = np.clip(poses, -MAX_DEVIATIONS, MAX_DEVIATIONS)
            self._attach_to_parent(bodies, parent, child)
        return bodies

    def _attach_to_parent(self, bodies: BodyState, parent: int, child: int) -> None:
        mesh = self.part_mesh(
            parent,
            bodies.center[:, parent],
            bodies.rotation[:, parent],
            bodies.pose[:, parent],
            bodies.shape[:, parent],
        )
        interface = self.interfaces[child - 1]
        target = mesh[:, interface.parent_index]
        stitched, _ = self.stitch(child, parent, target, bodies.pose[:, child], bodies.shape[:, child])
        relative = rotation.log(np.swapaxes(bodies.rotation[:, parent], -1, -2) @ stitched)
        limited = np.clip(relative, self.limit_low[child - 1], self.limit_high[child - 1])
        bodies.rotation[:, child] = bodies.rotation[:, parent] @ rotation.exp(limited)
        own = self.local_vertices(child, bodies.pose[:, child], bodies.shape[:, child])[:, interface.child_index]
        offsets = target - own @ np.swapaxes(bodies.rotation[:, child], -1, -2)
        bodies.center[:, child] = np.average(offsets, axis=1, weights=interface.weight)

    def mirror(self, state: BodyState) -> BodyState:
        """Mirror a body in the plane y = 0: left and right are swapped."""
        other = list(self.tree.mirror)
        pose = state.pose[..., other, :].copy()
        for i, signs in enumerate(self.pose_mirror):
            pose[..., i, : len(signs)] *= signs
        rotations = MIRROR_POINT[:, None] * state.rotation[..., other, :, :] * MIRROR_POINT
        return BodyState(state.center[..., other, :] * MIRROR_POINT, rotations, pose, state.shape[..., other, :])


def _arrays_of(state: BodyState) -> tuple[Array, Array, Array, Array]:
    return state.center, state.rotation, state.pose, state.shape


@lru_cache(maxsize=4)
def body_points(model: StitchedPuppet) -> BodyPoints:
    """Return the points of all parts of a model, made once."""
    means = [shape + pose for shape, pose in zip(model.mean_shape, model.mean_pose, strict=True)]
    return BodyPoints(model.part_vertices, means, model.pose_basis, model.shape_basis)


def pose_points(model: StitchedPuppet, state: BodyState) -> PosedPoints:
    """Return the points of all parts of one body."""
    return body_points(model).pose(state.center, state.rotation, state.pose, state.shape)


@lru_cache(maxsize=4)
def _fit_rest_pose(model: StitchedPuppet) -> Array:
    """Fit the pose coefficients (N, POSE_WIDTH) that undo the mean pose deformation."""
    pose = np.zeros((len(model.tree), POSE_WIDTH))
    for i in range(len(pose)):
        basis = model.pose_basis[i].reshape((-1, model.pose_count(i)))
        pose[i, : basis.shape[1]] = np.linalg.lstsq(basis, -model.mean_pose[i].ravel(), rcond=None)[0]
    return pose


@lru_cache(maxsize=4)
def _measure_rest_heights(model: StitchedPuppet) -> tuple[Array, Array]:
    """Return z (V,) m of the average body's vertices in the template pose, and what (V, 16 S) shapes add to it."""
    mean = model.vertices(model.rest_state())[:, 2]
    units = np.eye(len(model.tree) * model.shape_count).reshape((-1, len(model.tree), model.shape_count))
    change = [model.vertices(model.rest_state(unit))[:, 2] - mean for unit in units]
    return mean, np.ascontiguousarray(np.transpose(change))


@lru_cache(maxsize=3)
def _load_shared(name: str) -> StitchedPuppet:
    """Load a shipped model once; it is never changed, so the whole process shares it."""
    return StitchedPuppet.from_arrays(name, weights.load("sp", name))
