# SPDX-License-Identifier: Apache-2.0
"""From a stick figure to the puppet that stands in its place: linear regression of joints and scale.

The thesis learns such a function between the scales of stick figures and puppets (video chapter, "Inference"). Sticks
are linear in the puppet's joints, and the model has the mean and covariance of the joints of its training bodies, so
the regression is the mean of that Gaussian given the sticks: the least squares of all training bodies.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoints import SHOULDER_OUTWARDS, TRUNK_LOWERED, Keypoints
from flowing_puppet_ros.image.formats.stickmen import STICKS, sticks_from_joints
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

NOISE = 0.03
"""Standard deviation in metres of a stick's end that somebody marked, or a detector found."""

SOMEWHERE = 100.0  # m: where a person stands is unknown
ROUNDS = 3  # of scale and joints, each of which is told by the other
TORSO, HEAD = STICKS.index("torso"), STICKS.index("head")
UPPER_ARMS = tuple(STICKS.index(f"{side}_upper_arm") for side in ("left", "right"))


@dataclass(frozen=True, slots=True, eq=False)
class StickRegression:
    """Joints and scale of puppets of a model from sticks (6,2,2) px in the order of `sticks.STICKS`."""

    model: DeformableStructures
    _ends: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Write the sticks as a matrix (24, 2J) of the joints."""
        count = len(self.model.joint_names)
        units = np.eye(2 * count).reshape(-1, count, 2)
        ends = [sticks_from_joints(self.model.joint_names, unit).ravel() for unit in units]
        object.__setattr__(self, "_ends", np.array(ends).T)

    def keypoints(self, sticks: Array, confidence: float = 1.0) -> Keypoints:
        """The puppet's joints as keypoints that need no other mapping."""
        joints, _ = self(sticks)
        return Keypoints(self.model.joint_names, joints, np.full(len(joints), confidence))

    def __call__(self, sticks: Array, marked: bool = True) -> tuple[Array, float]:
        """Joints (J,2) px and scale px/m; ends of sticks may be NaN.

        `marked` sticks run between the shoulders and hips that people and detectors mark, which lie higher and further
        in than a puppet's (see `keypoints`); others are a puppet's own. InputError when too few sticks are known.
        """
        sticks = np.array(sticks, np.float64)
        if sticks.shape != (len(STICKS), 2, 2):
            raise InputError(f"sticks have the shape {sticks.shape}; a person has {(len(STICKS), 2, 2)}")
        if marked:
            sticks = _as_puppets(sticks)
        joints, confidence = self._known(sticks)
        scale = self.model.estimate_scale(joints, confidence)
        view = self.model.estimate_view(joints, confidence)
        mirror = np.array([1.0 if view == "front" else -1.0, 1.0])
        for _ in range(ROUNDS):
            joints = self._joints(sticks * mirror / scale) * mirror * scale
            scale = self.model.estimate_scale(joints, np.ones(len(joints)))
        return joints, scale

    def _known(self, sticks: Array) -> tuple[Array, Array]:
        """The joints that are ends of sticks, NaN the others, and their confidence."""
        joints = np.full((len(self.model.joint_names), 2), np.nan)
        for name, stick in zip(STICKS, sticks, strict=True):
            if name.endswith("arm"):
                side, which, _ = name.split("_")
                ends = ("shoulder", "elbow") if which == "upper" else ("elbow", "wrist")
                for end, place in zip(ends, stick, strict=True):
                    joints[self.model.joint_names.index(f"{side}_{end}")] = place
        joints[self.model.joint_names.index("neck")] = sticks[HEAD, 0]
        return joints, np.isfinite(joints).all(axis=1).astype(np.float64)

    def _joints(self, sticks: Array) -> Array:
        """Mean joints (J,2) in metres given sticks (6,2,2) in metres: the linear regression."""
        prior = self.model.joint_prior
        count = len(self.model.joint_names)
        values = sticks.ravel()
        seen = np.isfinite(values)
        ends = self._ends[seen]
        covariance = prior.covariance + SOMEWHERE**2 * np.kron(np.ones((count, count)), np.eye(2))
        cross = covariance @ ends.T
        own = ends @ cross + NOISE**2 * np.eye(int(seen.sum()))
        origin = np.nanmean(sticks.reshape(-1, 2), axis=0)
        told = values[seen] - np.tile(origin, values.size // 2)[seen] - ends @ prior.mean
        return np.asarray((prior.mean + cross @ np.linalg.solve(own, told)).reshape(count, 2) + origin)


def _as_puppets(sticks: Array) -> Array:
    """Sticks between a puppet's shoulders and hips, of those between the ones that people mark."""
    moved = sticks.copy()
    left, right = (sticks[k, 0] for k in UPPER_ARMS)
    down = TRUNK_LOWERED * (sticks[TORSO, 1] - sticks[TORSO, 0])
    if not np.isfinite(down).all():
        return moved
    moved[TORSO] += down
    for k, own, other in zip(UPPER_ARMS, (left, right), (right, left), strict=True):
        outwards = SHOULDER_OUTWARDS * (own - other)
        moved[k, 0] = own + down + np.where(np.isfinite(outwards), outwards, 0.0)
    return moved
