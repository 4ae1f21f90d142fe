# SPDX-License-Identifier: Apache-2.0
"""Parameters of an upper body: angles, lengths, shape of the torso, position and scale (thesis, "Inference" of video).

The search perturbs these instead of joints, since perturbed joints are not a body. Legs stay attached to the hips.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from flowing_puppet_ros.arrays import F64, Bools
from flowing_puppet_ros.inference.swarm import Bounds
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.shape import View, rotate

PARTS = ("torso", "head", "right_upper_arm", "right_lower_arm", "left_upper_arm", "left_lower_arm")
INERTIA = {"angle": 1.0, "length": 1.0, "shape": 0.5, "center": 0.1, "scale": 0.5}
"""Weights w of Eq. 37, as the thesis sets them."""

BOUND_SAMPLES, BOUND_SEED = 400, 0  # bodies drawn from the model to learn the bounds
TAIL_PERCENT = 0.5  # of the drawn bodies beyond either bound
MAX_TORSO_TURN_RAD = 0.4  # rotation of the torso from its start
MAX_SHAPE_DEVIATIONS = 2.5  # standard deviations of a shape coefficient
MAX_SHIFT_M = 0.15  # translation of the torso from its start
MAX_LOG_GROWTH = np.log(1.25)  # change of the logarithm of the scale from its start
_UNBOUNDED_RANGE_RAD = 1.8 * np.pi  # a joint with this range of angles has no bounds


@dataclass(frozen=True, slots=True, eq=False)
class UpperBodyParameters:
    """Map between vectors (P, D) and joints (P, J, 2) px of a model, for one side that the camera sees.

    A vector holds 6 angles (the torso's, then those of PARTS relative to their parents), 6 bone lengths in metres, the
    torso's shape coefficients, its centre in px (x mirrored from behind), and the logarithm of the scale in px/m.
    """

    model: DeformableStructures
    view: View
    parts: tuple[int, ...] = field(init=False)
    _bounds: tuple[F64, F64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Find the parts and learn the bounds from bodies drawn from the model."""
        object.__setattr__(self, "parts", tuple(self.model.tree.names.index(name) for name in PARTS))
        object.__setattr__(self, "_bounds", self._learn_bounds())

    @property
    def edges(self) -> list[int]:
        """Indices of the tree's edges between the parts."""
        return [child - 1 for child in self.parts if child > 0]

    @property
    def shape_size(self) -> int:
        """Number of shape coefficients of the torso."""
        return int(self.model.shapes[0].basis.shape[2])

    def slices(self) -> dict[str, slice]:
        """Return the slice of each kind of value in a vector."""
        ends = np.cumsum([0, len(PARTS), len(PARTS), self.shape_size, 2, 1])
        return {name: slice(int(a), int(b)) for name, a, b in zip(INERTIA, ends, ends[1:], strict=False)}

    def select_values(self, parts: tuple[str, ...]) -> Bools:
        """Return which values (D,) place these parts; for the torso, also its shape and position, and the scale."""
        where, free = self.slices(), np.zeros(2 * len(PARTS) + self.shape_size + 3, dtype=bool)
        for name in parts:
            k = PARTS.index(name)
            free[[where["angle"].start + k, where["length"].start + k]] = True
        if "torso" in parts:
            for name in ("shape", "center", "scale"):
                free[where[name]] = True
        return free

    def make_bounds(self, start: F64) -> Bounds:
        """Return the bounds around a person at `start` (D,): learned for limbs, around the start for the rest."""
        where, (low, high) = self.slices(), (bound.copy() for bound in self._bounds)
        for name, reach in (("center", MAX_SHIFT_M * np.exp(start[-1])), ("scale", MAX_LOG_GROWTH)):
            low[where[name]], high[where[name]] = start[where[name]] - reach, start[where[name]] + reach
        low[0], high[0] = start[0] - MAX_TORSO_TURN_RAD, start[0] + MAX_TORSO_TURN_RAD
        inertia = np.concatenate([np.full(part.stop - part.start, INERTIA[name]) for name, part in where.items()])
        return Bounds(low, high, inertia)

    def to_joints(self, vectors: F64, legs: F64) -> tuple[F64, F64]:
        """Return joints (P, J, 2) px and scales (P,) px/m of `vectors` (P, D); `legs` (J, 2) px as of `leg_offsets`."""
        where = self.slices()
        angle, length = vectors[:, where["angle"]], vectors[:, where["length"]]
        scale = np.exp(vectors[:, -1])
        center = vectors[:, where["center"]]
        joints = np.empty((len(vectors), len(self.model.joint_names), 2))
        local = self._torso_joints(vectors[:, where["shape"]])
        bone = local[:, 1, 0] - local[:, 0, 0]
        local[..., 0] *= (length[:, 0] / np.maximum(bone, 1e-6))[:, None]
        sine, cosine = np.sin(angle[:, :1]), np.cos(angle[:, :1])
        trunk = rotate(local, sine, cosine) * scale[:, None, None] + center[:, None]
        joints[:, list(self.model.part_joints[0])] = trunk
        absolute = angle.copy()
        for k in range(1, len(PARTS)):
            parent = PARTS.index(self.model.tree.names[self.model.tree.parents[self.parts[k]]])
            absolute[:, k] += absolute[:, parent]
            near, far = self.model.part_joints[self.parts[k]][:2]
            reach = (length[:, k] * scale)[:, None]
            direction = np.column_stack([np.cos(absolute[:, k]), np.sin(absolute[:, k])])
            joints[:, far] = joints[:, near] + reach * direction
        joints[..., 0] *= self._sign
        for side in ("right", "left"):
            hip = self.model.joint_names.index(f"{side}_hip")
            for below in self._leg_joints(side):
                joints[:, below] = joints[:, hip] + legs[below]
        return joints, scale

    def to_vectors(self, joints: F64, scale: F64) -> F64:
        """Return the vectors (P, D) of `joints` (P, J, 2) px at `scale` (P,) px/m.

        Elbows, wrists and face keep their position; shoulders follow the torso.
        """
        vectors = self._measure_vectors(joints, scale)
        limbs = slice(1, len(PARTS))
        middle = 0.5 * (self._bounds[0][limbs] + self._bounds[1][limbs])
        vectors[:, limbs] = (vectors[:, limbs] - middle + np.pi) % (2 * np.pi) - np.pi + middle
        return vectors

    def _measure_vectors(self, joints: F64, scale: F64) -> F64:
        """Return vectors as of `to_vectors`, with angles modulo a full turn."""
        mirrored = joints * np.array([self._sign, 1.0])
        coefficients = self.model.shape_coefficients(joints, scale, self.view)
        where = self.slices()
        vectors = np.empty((len(joints), where["scale"].stop))
        vectors[:, where["shape"]] = np.clip(coefficients[:, 0], -MAX_SHAPE_DEVIATIONS, MAX_SHAPE_DEVIATIONS)
        vectors[:, -1] = np.log(scale)
        neck, belly = (mirrored[:, joint] for joint in self.model.part_joints[0][:2])
        vectors[:, where["center"]] = (neck + belly) / 2
        bone = belly - neck
        vectors[:, 0] = np.arctan2(bone[:, 1], bone[:, 0])
        vectors[:, where["length"].start] = np.hypot(bone[:, 0], bone[:, 1]) / scale
        vectors[:, 1 : len(PARTS)], vectors[:, len(PARTS) + 1 : 2 * len(PARTS)] = 0.0, 0.1
        trunk = self.to_joints(vectors, np.zeros((joints.shape[1], 2)))[0] * np.array([self._sign, 1.0])
        placed = mirrored.copy()
        own = list(self.model.part_joints[0])
        placed[:, own] = trunk[:, own]
        absolute = {0: vectors[:, 0]}
        for k in range(1, len(PARTS)):
            near, far = self.model.part_joints[self.parts[k]][:2]
            bone = placed[:, far] - placed[:, near]
            absolute[self.parts[k]] = np.arctan2(bone[:, 1], bone[:, 0])
            vectors[:, k] = absolute[self.parts[k]] - absolute[self.model.tree.parents[self.parts[k]]]
            vectors[:, len(PARTS) + k] = np.hypot(bone[:, 0], bone[:, 1]) / scale
        return vectors

    def leg_offsets(self, joints: F64) -> F64:
        """Return the offsets (J, 2) px of knees, ankles and feet from their hip, of `joints` (J, 2); 0 for others."""
        legs = np.zeros_like(joints)
        for side in ("right", "left"):
            for below in self._leg_joints(side):
                legs[below] = joints[below] - joints[self.model.joint_names.index(f"{side}_hip")]
        return legs

    @property
    def _sign(self) -> float:
        return 1.0 if self.view == "front" else -1.0

    def _leg_joints(self, side: str) -> list[int]:
        names = (f"{side}_{name}" for name in ("knee", "ankle", "foot"))
        return [self.model.joint_names.index(name) for name in names if name in self.model.joint_names]

    def _torso_joints(self, shape: F64) -> F64:
        """Return the torso's joints (P, M, 2) m in its bone frame for `shape` coefficients (P, Z)."""
        torso = self.model.shapes[0]
        count = torso.joint_count
        return np.asarray(torso.mean[-count:] + np.tensordot(shape, torso.basis[-count:], axes=(1, 2)))

    def _learn_bounds(self) -> tuple[F64, F64]:
        """Learn bounds (D,) of limb angles and lengths from drawn bodies; none for angles of a full turn."""
        rng = np.random.default_rng(BOUND_SEED)
        joints = np.array([self.model.sample(rng).joints for _ in range(BOUND_SAMPLES)]) * np.array([self._sign, 1.0])
        drawn = self._measure_vectors(joints, np.ones(BOUND_SAMPLES))
        angles = drawn[:, 1 : len(PARTS)]
        middle = np.arctan2(np.sin(angles).mean(axis=0), np.cos(angles).mean(axis=0))
        drawn[:, 1 : len(PARTS)] = (angles - middle + np.pi) % (2 * np.pi) - np.pi + middle
        low, high = np.percentile(drawn, [TAIL_PERCENT, 100 - TAIL_PERCENT], axis=0)
        unbounded = np.zeros(len(low), dtype=bool)
        unbounded[1 : len(PARTS)] = (high - low)[1 : len(PARTS)] > _UNBOUNDED_RANGE_RAD
        middles = np.zeros(len(low))
        middles[1 : len(PARTS)] = middle
        low, high = (
            np.where(unbounded, middles - 1.5 * np.pi, low),
            np.where(unbounded, middles + 1.5 * np.pi, high),
        )
        shape = self.slices()["shape"]
        low[shape], high[shape] = -MAX_SHAPE_DEVIATIONS, MAX_SHAPE_DEVIATIONS
        return low, high
