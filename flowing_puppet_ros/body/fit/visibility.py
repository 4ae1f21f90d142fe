# SPDX-License-Identifier: Apache-2.0
"""Which vertices, joints and parts of a fitted body the sensor saw, and which only the model tells."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from flowing_puppet_ros.arrays import F64, I8
from flowing_puppet_ros.body.cloud.correspondence import Cloud, SurfaceDistances
from flowing_puppet_ros.model.sp import StitchedPuppet

MAX_SEEN_DISTANCE_M = 0.04  # between a vertex that was seen and the cloud
MAX_NEAR_DISTANCE_M = 0.10  # about the thickness of a limb, whose other side may have been seen
MIN_SEEN_SHARE, MIN_NEAR_SHARE = 0.1, 0.3
"""Share of the vertices of a joint or part, by weight, from which on it counts as seen, and as near the cloud."""

JOINT_CONFIDENCE = np.array([0.48, 0.97, 0.97])
"""Probability that a joint of a reliable body that is inferred, near the cloud, or seen is within 10 cm.

Measured by `flowing-puppet evaluate rgbd --count 12 --people-seed 7 --mocap expmap_20hz.npz`, whose second table has
what is said and what is.
"""


class Visibility(IntEnum):
    """What the cloud says about a place on the body; the higher, the more."""

    INFERRED = 0
    """Out of sight and away from the cloud: the model's guess from what was seen."""
    NEAR = 1
    """Not seen, but close to what was: the far side of a limb, or a limb behind another."""
    SEEN = 2
    """On the cloud, where the sensor could see it."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyVisibility:
    """The `Visibility` of a body's `vertices` (V,), `joints` (J,) and `parts` (16,)."""

    vertices: I8
    joints: I8
    parts: I8

    @classmethod
    def of_vertices(cls, model: StitchedPuppet, state: I8) -> BodyVisibility:
        """Return that of a body from the `Visibility` (V,) of its vertices.

        A joint or part is seen if a tenth of its vertices are, and near if three tenths are seen or near.
        """
        owner, parts = model.part_of_vertex, len(model.tree)
        size = np.bincount(owner, minlength=parts)
        seen, near = (np.bincount(owner, state >= level, minlength=parts) / size for level in (2, 1))
        joints = [((state[model.joint_index] >= level) * model.joint_weight).sum(axis=1) for level in (2, 1)]
        return cls(state, _judge_shares(joints[0], joints[1]), _judge_shares(seen, near))


def rate_joints(visibility: I8, reliable: bool, confidence: float) -> F64:
    """Return the confidence (J,) of joints of a `visibility` (J,): that of a body that is not reliable lowers it."""
    return np.asarray((1.0 if reliable else confidence) * JOINT_CONFIDENCE[visibility])


def judge_visibility(
    model: StitchedPuppet, vertices: np.ndarray, cloud: Cloud, surface: SurfaceDistances
) -> BodyVisibility:
    """Tell what a cloud says about each place on a body with `vertices` (V, 3) in metres, `surface` from the cloud.

    A vertex is seen if it faces the sensor, is neither hidden nor out of its view, and lies within 4 cm of the cloud;
    it is near if it lies within 10 cm.
    """
    could_see, distance = surface.seen[: len(vertices)], np.empty(len(vertices))
    distance[could_see] = surface.to_cloud[: np.count_nonzero(could_see)]
    distance[~could_see] = cloud.nearest.query(vertices[~could_see])[0]
    state = np.where(distance <= MAX_NEAR_DISTANCE_M, Visibility.NEAR, Visibility.INFERRED).astype(np.int8)
    state[could_see & (distance <= MAX_SEEN_DISTANCE_M)] = Visibility.SEEN
    return BodyVisibility.of_vertices(model, state)


def _judge_shares(seen: np.ndarray, near: np.ndarray) -> I8:
    """Return the visibility (K,) of what has these shares (K,) of vertices seen, and seen or near."""
    state = np.where(near >= MIN_NEAR_SHARE, Visibility.NEAR, Visibility.INFERRED)
    return np.where(seen >= MIN_SEEN_SHARE, Visibility.SEEN, state).astype(np.int8)
