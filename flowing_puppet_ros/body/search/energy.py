# SPDX-License-Identifier: Apache-2.0
"""The energy of Stitched Puppet particles: data, joints and stitching (thesis Eqs. 48 and 50-54).

Unlike in Eq. 51, where the sum over all parts and their neighbours counts every edge twice, each edge counts once; the
gaps' `strength` makes up for it. The cost of joint targets is not in the thesis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.search.part_points import PartPoints
from flowing_puppet_ros.body.search.particles import Particles
from flowing_puppet_ros.evidence.cloud.data_term import DataCost
from flowing_puppet_ros.model.sp import StitchedPuppet

RAY_SHARE = 0.1
MIN_CENTRE_DISTANCE_M = 0.05  # between the centres of neighbouring parts, Eq. 51


@dataclass(frozen=True, slots=True, eq=False)
class JointTargets:
    """Expected positions of joints.

    Attributes:
        points: (J, 3) metres in the model's joint order; arbitrary where the weight is 0.
        weight: (J,) at least 0, confidence times strength (per squared metre of distance).
        rays: (J, 3) unit vectors from a camera to the joints, along which a gap counts `RAY_SHARE` of its length in
            the refinement, since an image knows little of the depth; None: gaps count alike in all directions.
    """

    points: np.ndarray
    weight: np.ndarray
    rays: np.ndarray | None = None

    @classmethod
    def none(cls, model: StitchedPuppet) -> JointTargets:
        """Return targets without any weight."""
        count = len(model.joint_names)
        return cls(np.zeros((count, 3)), np.zeros(count))

    def scale(self, strength: float) -> JointTargets:
        """Return the same positions with `strength` times the weight."""
        return JointTargets(self.points, strength * self.weight, self.rays)


@dataclass(frozen=True, slots=True, eq=False)
class ScoredParticles:
    """Particles with all that the energy needs of them, so that kept ones are not computed again.

    Attributes:
        particles: the hypotheses.
        distance: (P,) Eq. 53.
        mismatch: (P,) share of contradicting normals, 0 to 1.
        joint_cost: (P,) weighted squared distance of the part's joints to their targets, square metres.
        interfaces: for each edge the interface points (P, K, 3) in the common frame, metres.
    """

    particles: Particles
    distance: np.ndarray
    mismatch: np.ndarray
    joint_cost: np.ndarray
    interfaces: dict[int, np.ndarray]

    @classmethod
    def score(cls, points: PartPoints, particles: Particles, cloud: DataCost, targets: JointTargets) -> ScoredParticles:
        """Compare particles of one part with the cloud and with joint targets."""
        normals = points.normals @ particles.rotation.transpose(0, 2, 1)
        distance, mismatch = cloud.data_cost(points.surface.to_world(particles), normals)
        weight = targets.weight[points.joint_index]
        gap = points.joints.to_world(particles) - targets.points[points.joint_index]
        interfaces = {edge: interface.to_world(particles) for edge, interface in points.interfaces.items()}
        return cls(particles, distance, mismatch, (gap**2).sum(axis=2) @ weight, interfaces)

    def take(self, index: np.ndarray) -> ScoredParticles:
        """Return the scored particles of `index`."""
        return ScoredParticles(
            self.particles.take(index),
            self.distance[index],
            self.mismatch[index],
            self.joint_cost[index],
            {edge: points[index] for edge, points in self.interfaces.items()},
        )

    def extend(self, other: ScoredParticles) -> ScoredParticles:
        """Return these particles followed by the others."""
        return ScoredParticles(
            Particles.join([self.particles, other.particles]),
            np.concatenate([self.distance, other.distance]),
            np.concatenate([self.mismatch, other.mismatch]),
            np.concatenate([self.joint_cost, other.joint_cost]),
            {edge: np.concatenate([self.interfaces[edge], other.interfaces[edge]]) for edge in self.interfaces},
        )


def stitching_costs(
    weight: np.ndarray, parent: np.ndarray, child: np.ndarray, centers: tuple[np.ndarray, np.ndarray], strength: float
) -> np.ndarray:
    """Return the stitching cost of every pair of particles at one edge (Eqs. 48 and 51, without alpha).

    Args:
        weight: (K,) weights u of the interface points.
        parent: (P, K, 3) interface points of the parent's particles, metres.
        child: (Q, K, 3) the same points of the child's particles.
        centers: (P, 3) and (Q, 3) part centres; pairs closer than 5 cm cost 1 more for penetration.
        strength: factor of the squared gaps.

    Returns:
        Costs (P, Q).
    """
    middle = parent.mean(axis=(0, 1))
    root = np.sqrt(weight / weight.sum())[:, None]
    a = (root * (parent - middle)).reshape(len(parent), -1)
    b = (root * (child - middle)).reshape(len(child), -1)
    gaps = np.maximum((a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2 * (a @ b.T), 0.0)
    distance = np.linalg.norm(centers[0][:, None, :] - centers[1], axis=2)
    return strength * gaps + (distance < MIN_CENTRE_DISTANCE_M)
