# SPDX-License-Identifier: Apache-2.0
"""The energy of Stitched Puppet particles: data, joints and stitching (thesis Eqs. 48 and 50-54).

Other than in Eq. 51, where the sum over all parts and their neighbours takes every edge twice, an edge counts once;
the gaps' `strength` makes up for it. The pull of believed joints is not in the thesis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.search.part_points import PartPoints
from flowing_puppet_ros.body.search.particles import Particles
from flowing_puppet_ros.evidence.cloud.data_term import DataCost
from flowing_puppet_ros.model.sp import StitchedPuppet

TOO_CLOSE = 0.05  # metres between the centres of neighbours, Eq. 51


@dataclass(frozen=True, slots=True, eq=False)
class JointTargets:
    """Where joints are believed to be.

    Attributes:
        points: (J, 3) metres in the model's joint order; anything where the weight is 0.
        weight: (J,) at least 0, confidence times strength (per squared metre of distance).
    """

    points: np.ndarray
    weight: np.ndarray

    @classmethod
    def none(cls, model: StitchedPuppet) -> JointTargets:
        """No beliefs."""
        count = len(model.joint_names)
        return cls(np.zeros((count, 3)), np.zeros(count))

    def scaled(self, strength: float) -> JointTargets:
        """The same places believed `strength` times as much."""
        return JointTargets(self.points, strength * self.weight)


@dataclass(frozen=True, slots=True, eq=False)
class ScoredParticles:
    """Particles with all that the energy needs of them, so that kept ones are not computed again.

    Attributes:
        particles: the hypotheses.
        distance: (P,) Eq. 53.
        mismatch: (P,) share of contradicting normals.
        pull: (P,) weighted squared distance of the part's joints to where they are believed to be, square metres.
        interfaces: per edge the interface points (P, K, 3) in the common frame.
    """

    particles: Particles
    distance: np.ndarray
    mismatch: np.ndarray
    pull: np.ndarray
    interfaces: dict[int, np.ndarray]

    @classmethod
    def judge(cls, points: PartPoints, particles: Particles, cloud: DataCost, targets: JointTargets) -> ScoredParticles:
        """Compare particles of one part with the cloud and with believed joints."""
        normals = points.normals @ particles.rotation.transpose(0, 2, 1)
        distance, mismatch = cloud.data_cost(points.surface.world(particles), normals)
        weight = targets.weight[points.joint_index]
        gap = points.joints.world(particles) - targets.points[points.joint_index]
        interfaces = {edge: interface.world(particles) for edge, interface in points.interfaces.items()}
        return cls(particles, distance, mismatch, (gap**2).sum(axis=2) @ weight, interfaces)

    def take(self, index: np.ndarray) -> ScoredParticles:
        """Return the judged particles of `index`."""
        return ScoredParticles(
            self.particles.take(index),
            self.distance[index],
            self.mismatch[index],
            self.pull[index],
            {edge: points[index] for edge, points in self.interfaces.items()},
        )

    def extend(self, other: ScoredParticles) -> ScoredParticles:
        """Return these particles followed by the other ones."""
        return ScoredParticles(
            Particles.join([self.particles, other.particles]),
            np.concatenate([self.distance, other.distance]),
            np.concatenate([self.mismatch, other.mismatch]),
            np.concatenate([self.pull, other.pull]),
            {edge: np.concatenate([self.interfaces[edge], other.interfaces[edge]]) for edge in self.interfaces},
        )


def stitching_costs(
    weight: np.ndarray, parent: np.ndarray, child: np.ndarray, centers: tuple[np.ndarray, np.ndarray], strength: float
) -> np.ndarray:
    """Stitching cost of every pair of particles at one edge (Eqs. 48 and 51, without alpha).

    Args:
        weight: (K,) weights u of the interface points.
        parent: (P, K, 3) interface points of the parent's particles, metres.
        child: (Q, K, 3) the same points of the child's particles.
        centers: (P, 3) and (Q, 3) part centres; pairs closer than 5 cm pay 1 for penetration.
        strength: factor of the squared gaps.

    Returns:
        (P, Q) costs.
    """
    middle = parent.mean(axis=(0, 1))
    root = np.sqrt(weight / weight.sum())[:, None]
    a = (root * (parent - middle)).reshape(len(parent), -1)
    b = (root * (child - middle)).reshape(len(child), -1)
    gaps = np.maximum((a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2 * (a @ b.T), 0.0)
    apart = np.linalg.norm(centers[0][:, None, :] - centers[1], axis=2)
    return strength * gaps + (apart < TOO_CLOSE)
