# SPDX-License-Identifier: Apache-2.0
"""From a stick figure to the puppet in the same pose: linear regression of joints and scale.

The thesis learns such a function between the scales of stick figures and puppets (video chapter, "Inference"). Sticks
are linear in the puppet's joints, and the model has the mean and covariance of the joints of its training bodies. The
regression is therefore the mean of that Gaussian given the sticks, the least-squares fit over all training bodies.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoints import SHOULDER_SPREAD, TRUNK_DROP, Keypoints
from flowing_puppet_ros.image.formats.stickmen import STICKS, sticks_from_joints
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

END_NOISE_M = 0.03
"""Standard deviation of a stick's end that an annotator marked or a detector found."""

POSITION_SD_M = 100.0  # prior of where a person stands: unknown
SCALE_ROUNDS = 3  # alternations between scale and joints, each estimated from the other
TORSO, HEAD = STICKS.index("torso"), STICKS.index("head")
UPPER_ARMS = tuple(STICKS.index(f"{side}_upper_arm") for side in ("left", "right"))


@dataclass(frozen=True, slots=True, eq=False)
class StickRegression:
    """Joints and scale of puppets of a model from sticks (6, 2, 2) px in the order of `stickmen.STICKS`."""

    model: DeformableStructures
    _ends: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Write the sticks as a matrix (24, 2J) of the joints."""
        count = len(self.model.joint_names)
        units = np.eye(2 * count).reshape(-1, count, 2)
        ends = [sticks_from_joints(self.model.joint_names, unit).ravel() for unit in units]
        object.__setattr__(self, "_ends", np.array(ends).T)

    def to_keypoints(self, sticks: Array, confidence: float = 1.0) -> Keypoints:
        """Return the puppet's joints as keypoints that need no further mapping."""
        joints, _ = self(sticks)
        return Keypoints(self.model.joint_names, joints, np.full(len(joints), confidence))

    def __call__(self, sticks: Array, is_marked: bool = True) -> tuple[Array, float]:
        """Estimate joints (J, 2) px and scale px/m from `sticks` (6, 2, 2) px; ends may be NaN.

        Sticks that `is_marked` run between the shoulders and hips that people and detectors mark, which lie higher and
        further in than a puppet's (see `keypoints`); others are a puppet's own. InputError when too few are known.
        """
        sticks = np.array(sticks, np.float64)
        if sticks.shape != (len(STICKS), 2, 2):
            raise InputError(f"sticks have the shape {sticks.shape}; a person has {(len(STICKS), 2, 2)}")
        if is_marked:
            sticks = _to_puppet_sticks(sticks)
        joints, confidence = self._joints_at_ends(sticks)
        scale = self.model.estimate_scale(joints, confidence)
        view = self.model.estimate_view(joints, confidence)
        mirror = np.array([1.0 if view == "front" else -1.0, 1.0])
        for _ in range(SCALE_ROUNDS):
            joints = self._regress_joints(sticks * mirror / scale) * mirror * scale
            scale = self.model.estimate_scale(joints, np.ones(len(joints)))
        return joints, scale

    def _joints_at_ends(self, sticks: Array) -> tuple[Array, Array]:
        """Return the joints (J, 2) at the ends of sticks, the others NaN, and their confidence (J,)."""
        joints = np.full((len(self.model.joint_names), 2), np.nan)
        for name, stick in zip(STICKS, sticks, strict=True):
            if name.endswith("arm"):
                side, which, _ = name.split("_")
                ends = ("shoulder", "elbow") if which == "upper" else ("elbow", "wrist")
                for end, place in zip(ends, stick, strict=True):
                    joints[self.model.joint_names.index(f"{side}_{end}")] = place
        joints[self.model.joint_names.index("neck")] = sticks[HEAD, 0]
        return joints, np.isfinite(joints).all(axis=1).astype(np.float64)

    def _regress_joints(self, sticks: Array) -> Array:
        """Return the mean joints (J, 2) m given sticks (6, 2, 2) m: the linear regression."""
        prior = self.model.joint_prior
        count = len(self.model.joint_names)
        values = sticks.ravel()
        known = np.isfinite(values)
        ends = self._ends[known]
        covariance = prior.covariance + POSITION_SD_M**2 * np.kron(np.ones((count, count)), np.eye(2))
        cross = covariance @ ends.T
        stick_covariance = ends @ cross + END_NOISE_M**2 * np.eye(int(known.sum()))
        origin = np.nanmean(sticks.reshape(-1, 2), axis=0)
        deviation = values[known] - np.tile(origin, values.size // 2)[known] - ends @ prior.mean
        return np.asarray(
            (prior.mean + cross @ np.linalg.solve(stick_covariance, deviation)).reshape(count, 2) + origin
        )


def _to_puppet_sticks(sticks: Array) -> Array:
    """Move sticks between marked shoulders and hips to those of a puppet."""
    moved = sticks.copy()
    left, right = (sticks[k, 0] for k in UPPER_ARMS)
    down = TRUNK_DROP * (sticks[TORSO, 1] - sticks[TORSO, 0])
    if not np.isfinite(down).all():
        return moved
    moved[TORSO] += down
    for k, own, other in zip(UPPER_ARMS, (left, right), (right, left), strict=True):
        outwards = SHOULDER_SPREAD * (own - other)
        moved[k, 0] = own + down + np.where(np.isfinite(outwards), outwards, 0.0)
    return moved
