# SPDX-License-Identifier: Apache-2.0
"""Particles: hypotheses of the Stitched Puppet's parts, and the bodies assembled from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.model.sp import POSE_WIDTH, BodyState, StitchedPuppet


@dataclass(frozen=True, slots=True, eq=False)
class Particles:
    """Hypotheses of one part (Eq. 44, with the rotation as a matrix).

    Attributes:
        center: (P, 3) metres.
        rotation: (P, 3, 3) from the template pose.
        pose: (P, D) pose deformation coefficients, standard deviations.
        shape: (P, S) intrinsic shape coefficients, standard deviations.
    """

    center: np.ndarray
    rotation: np.ndarray
    pose: np.ndarray
    shape: np.ndarray

    def __len__(self) -> int:
        return len(self.center)

    def take(self, index: np.ndarray) -> Particles:
        """Return the particles of `index`."""
        return Particles(self.center[index], self.rotation[index], self.pose[index], self.shape[index])

    @classmethod
    def join(cls, groups: list[Particles]) -> Particles:
        """Return the particles of all groups, in order."""
        return cls(
            np.concatenate([group.center for group in groups]),
            np.concatenate([group.rotation for group in groups]),
            np.concatenate([group.pose for group in groups]),
            np.concatenate([group.shape for group in groups]),
        )


def particles_to_state(model: StitchedPuppet, groups: list[Particles], pick: np.ndarray) -> BodyState:
    """Assemble the body of particle `pick[i]` of every part i."""
    pose = np.zeros((len(groups), POSE_WIDTH))
    for part, group in enumerate(groups):
        pose[part, : group.pose.shape[1]] = group.pose[pick[part]]
    return BodyState(
        np.stack([group.center[p] for group, p in zip(groups, pick, strict=True)]),
        np.stack([group.rotation[p] for group, p in zip(groups, pick, strict=True)]),
        pose,
        np.stack([group.shape[p] for group, p in zip(groups, pick, strict=True)]),
    )


def states_to_particles(model: StitchedPuppet, states: list[BodyState]) -> list[Particles]:
    """Return the particles of each part, one for every body."""
    arrays = [np.stack([getattr(state, name) for state in states]) for name in ("center", "rotation", "pose", "shape")]
    center, rotation, pose, shape = arrays
    return [
        Particles(center[:, part], rotation[:, part], pose[:, part, : model.pose_count(part)], shape[:, part])
        for part in range(len(model.tree))
    ]
