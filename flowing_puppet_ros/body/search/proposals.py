# SPDX-License-Identifier: Apache-2.0
"""Proposals of new particles: random walks, neighbours and parents (thesis, "Resampling and refinement")."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.search.energy import ScoredParticles
from flowing_puppet_ros.body.search.part_points import PartPoints, PointSet
from flowing_puppet_ros.body.search.particles import Particles
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.gaussian import Gaussian
from flowing_puppet_ros.model.sp import MAX_DEVIATIONS, StitchedPuppet


@dataclass(frozen=True, slots=True)
class WalkNoise:
    """Standard deviations of a random walk: centre in metres, rotation in radians, pose and shape coefficients."""

    center: float
    rotation: float
    pose: float
    shape: float


@dataclass(frozen=True, slots=True, eq=False)
class Conditional:
    """A Gaussian of some variables given others (Eqs. 13 and 14), factored once and sampled often."""

    offset: np.ndarray
    gain: np.ndarray
    factor: np.ndarray

    @classmethod
    def of(cls, joint: Gaussian, kept: np.ndarray, given: np.ndarray) -> Conditional:
        """Prepare p(kept | given); variables in neither are marginalised out."""
        return cls(*joint.make_conditional(kept, given))

    def sample(self, rng: np.random.Generator, values: np.ndarray) -> np.ndarray:
        """Draw one sample (n, kept) for every row of `values` (n, given)."""
        noise = rng.standard_normal((len(values), len(self.offset)))
        return self.offset + values @ self.gain.T + noise @ self.factor.T


class Proposer:
    """Proposals of new particles for the parts of one model."""

    def __init__(self, model: StitchedPuppet, points: tuple[PartPoints, ...]) -> None:
        self._model = model
        self._points = points
        self._neighbours = [np.array(model.tree.neighbours(part)) for part in range(len(model.tree))]
        self._deformation: dict[tuple[int, int], tuple[Conditional, Conditional]] = {}
        # The weighted mean of an edge's interface points, as each of its two parts moves it.
        self._middles: dict[tuple[int, int], PointSet] = {}
        for edge, (parent, child) in enumerate(model.tree.edges):
            relative = np.arange(3)
            of_parent = 3 + np.arange(model.pose_count(parent))
            of_child = of_parent[-1] + 1 + np.arange(model.pose_count(child))
            for part, kept, other, given in (
                (child, of_child, parent, of_parent),
                (parent, of_parent, child, of_child),
            ):
                weight = model.interfaces[edge].weight[None] / model.interfaces[edge].weight.sum()
                self._middles[part, edge] = points[part].interfaces[edge].blend(weight, np.zeros((1, 3)))
                self._deformation[part, other] = (
                    Conditional.of(model.pairwise[edge], kept, given),
                    Conditional.of(model.pairwise[edge], kept, np.concatenate([relative, given])),
                )

    def propose(
        self,
        part: int,
        scored: list[ScoredParticles],
        noise: WalkNoise,
        neighbour_share: float,
        rng: np.random.Generator,
    ) -> Particles:
        """Propose one new particle for every present one of `part`.

        With probability `neighbour_share` it comes from a random particle of a random neighbour, otherwise from a
        random walk that starts at the present one, half the time in the pose deformation only.
        """
        present = scored[part].particles
        count = len(present)
        from_neighbour = rng.random(count) < neighbour_share
        neighbour = rng.choice(self._neighbours[part], count)
        groups = [self.random_walk(present.take(np.flatnonzero(~from_neighbour)), noise, rng, deformation_only=0.5)]
        for other in self._neighbours[part]:
            wanted = int(np.count_nonzero(from_neighbour & (neighbour == other)))
            if wanted:
                source = scored[other].take(rng.integers(0, len(scored[other].particles), wanted))
                groups.append(self._stitch_to_neighbour(part, int(other), source, rng))
        return Particles.join(groups)

    def random_walk(
        self, particles: Particles, noise: WalkNoise, rng: np.random.Generator, deformation_only: float = 0.0
    ) -> Particles:
        """Perturb particles; with probability `deformation_only` only their pose deformation."""
        count, deformations = particles.pose.shape
        whole = (rng.random((count, 1)) >= deformation_only).astype(np.float64)
        rotation = rng.normal(0.0, noise.rotation, (count, 3)) * whole
        pose = particles.pose + rng.normal(0.0, noise.pose, (count, deformations))
        shape = particles.shape + rng.normal(0.0, noise.shape, particles.shape.shape) * whole
        return Particles(
            particles.center + rng.normal(0.0, noise.center, (count, 3)) * whole,
            so3.exp(rotation) @ particles.rotation,
            np.clip(pose, -MAX_DEVIATIONS, MAX_DEVIATIONS),
            np.clip(shape, -MAX_DEVIATIONS, MAX_DEVIATIONS),
        )

    def attach_to_parent(self, part: int, parent: Particles, shape: np.ndarray, rng: np.random.Generator) -> Particles:
        """Attach a part to particles of its parent, with uniformly random rotations within the joint's limits.

        Args:
            part: the part to attach.
            parent: one particle for each new one.
            shape: (S,) intrinsic shape of the new ones.
            rng: source of all randomness.
        """
        edge = part - 1
        relative = rng.uniform(self._model.limit_low[edge], self._model.limit_high[edge], (len(parent), 3))
        return self._attach(part, parent, relative, shape, rng)

    def attach_likely(self, part: int, parent: Particles, shape: np.ndarray, rng: np.random.Generator) -> Particles:
        """Attach a part like `attach_to_parent`, but with rotations drawn from the joint's Gaussian (Eq. 49)."""
        edge = part - 1
        joint = self._model.pairwise[edge]
        drawn = rng.multivariate_normal(joint.mean[:3], joint.covariance[:3, :3], len(parent), method="cholesky")
        relative = np.clip(drawn, self._model.limit_low[edge], self._model.limit_high[edge])
        return self._attach(part, parent, relative, shape, rng)

    def reattach(self, part: int, parent: Particles, before: Sequence[Particles], above: int) -> Particles:
        """Attach a part to particles of its parent `above` as it was attached to those `before`, of all parts."""
        own, earlier = before[part], before[above]
        turn = parent.rotation @ np.swapaxes(earlier.rotation, -1, -2)
        center = parent.center + (turn @ (own.center - earlier.center)[:, :, None])[:, :, 0]
        return Particles(center, turn @ own.rotation, own.pose, own.shape)

    def point_to(self, part: int, particles: Particles, joint: int, target: np.ndarray) -> Particles:
        """Turn a part about where it joins its parent so that its `joint` lies towards `target` (P, 3) m, if finite."""
        points, known = self._points[part], np.isfinite(target).all(axis=1)
        weight = self._model.interfaces[part - 1].weight
        near = np.average(points.interfaces[part - 1].to_world(particles), axis=1, weights=weight)
        number = int(np.flatnonzero(points.joint_index == joint)[0])
        far, aim = points.joints.to_world(particles)[:, number], np.where(known[:, None], target, 0.0)
        turn = _turn_between(far - near, aim - near)
        turn[~known] = np.eye(3)
        center = near + (turn @ (particles.center - near)[:, :, None])[:, :, 0]
        return Particles(center, turn @ particles.rotation, particles.pose, particles.shape)

    def find_joints(self, part: int, particles: Particles) -> tuple[np.ndarray, np.ndarray]:
        """Return the indices (M,) of the joints that a part determines alone, and their places (P, M, 3), metres."""
        points = self._points[part]
        return points.joint_index, points.joints.to_world(particles)

    def _attach(
        self, part: int, parent: Particles, relative: np.ndarray, shape: np.ndarray, rng: np.random.Generator
    ) -> Particles:
        """Attach a part to its parent's particles, turned by rotation vectors `relative` (P, 3) in their frames."""
        edge, above = part - 1, self._model.tree.parents[part]
        sampled = self._deformation[part, above][1].sample(rng, np.concatenate([relative, parent.pose], axis=1))
        pose, shapes = np.clip(sampled, -MAX_DEVIATIONS, MAX_DEVIATIONS), np.tile(shape, (len(parent), 1))
        rotation = parent.rotation @ so3.exp(relative)
        target = self._middles[above, edge].to_world(parent)[:, 0]
        own = self._middles[part, edge].deform(pose, shapes)
        return Particles(target - (rotation @ own.transpose(0, 2, 1))[:, :, 0], rotation, pose, shapes)

    def _stitch_to_neighbour(
        self, part: int, other: int, source: ScoredParticles, rng: np.random.Generator
    ) -> Particles:
        """Stitch `part` to particles of its neighbour, with its deformation sampled given the neighbour's.

        Half of them are sampled given a relative rotation as well, uniform within the joint's limits.
        """
        edge = max(part, other) - 1
        free, rotated = self._deformation[part, other]
        given = source.particles
        pose = free.sample(rng, given.pose)
        relative = rng.uniform(self._model.limit_low[edge], self._model.limit_high[edge], (len(given), 3))
        with_rotation = rotated.sample(rng, np.concatenate([relative, given.pose], axis=1))
        pose = np.where(rng.random((len(given), 1)) < 0.5, pose, with_rotation)
        pose = np.clip(pose, -MAX_DEVIATIONS, MAX_DEVIATIONS)
        local = self._points[part].interfaces[edge].deform(pose, given.shape)
        weight = self._model.interfaces[edge].weight
        rotation, center = so3.procrustes(local, source.interfaces[edge], weight)
        return Particles(center, rotation, pose, given.shape)


def _turn_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the smallest rotations (P, 3, 3) that take the directions of a (P, 3) to those of b (P, 3)."""
    a, b = (side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12) for side in (a, b))
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, (a * b).sum(axis=1))
    return so3.exp(axis * (angle / np.maximum(sine, 1e-12))[:, None])
