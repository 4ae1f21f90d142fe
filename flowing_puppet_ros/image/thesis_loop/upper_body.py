# SPDX-License-Identifier: Apache-2.0
"""An upper body as a vector: angles, lengths, shape of the torso, place and scale (thesis, "Inference" of video).

The search perturbs these instead of joints, since perturbed joints make no bodies. Legs keep their place at the hips.
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

DRAWN, SEED = 400, 0  # bodies drawn from the model to learn the bounds from
TAIL = 0.5  # percent of the drawn bodies beyond either bound
TURN = 0.4  # rad that the torso may lean from where it starts
SHAPE = 2.5  # standard deviations of a shape coefficient
SHIFT = 0.15  # m that the torso may be off from where it starts
GROWTH = np.log(1.25)  # of the scale from where it starts
_ALL_ROUND = 1.8 * np.pi  # a joint that reaches this far has no bounds


@dataclass(frozen=True, slots=True, eq=False)
class UpperBodyParameters:
    """Maps vectors (P,D) to joints (P,J,2) px of a model and back, for one side that the camera sees.

    Order: 6 angles (the torso's, then those of PARTS relative to their parents), 6 bone lengths in metres, the torso's
    shape coefficients, its centre in px (x mirrored from behind), the logarithm of the scale in px/m.
    """

    model: DeformableStructures
    view: View
    parts: tuple[int, ...] = field(init=False)
    _bounds: tuple[F64, F64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Find the parts and learn the bounds from bodies that the model draws."""
        object.__setattr__(self, "parts", tuple(self.model.tree.names.index(name) for name in PARTS))
        object.__setattr__(self, "_bounds", self._learned_bounds())

    @property
    def edges(self) -> list[int]:
        """Indices of the tree's edges between the parts."""
        return [child - 1 for child in self.parts if child > 0]

    @property
    def shape_size(self) -> int:
        """Number of shape coefficients of the torso."""
        return int(self.model.shapes[0].basis.shape[2])

    def slices(self) -> dict[str, slice]:
        """Where each kind of value stands in a vector."""
        ends = np.cumsum([0, len(PARTS), len(PARTS), self.shape_size, 2, 1])
        return {name: slice(int(a), int(b)) for name, a, b in zip(INERTIA, ends, ends[1:], strict=False)}

    def free(self, parts: tuple[str, ...]) -> Bools:
        """(D,) the values that place these parts; with the torso its shape, place and the scale too."""
        where, free = self.slices(), np.zeros(2 * len(PARTS) + self.shape_size + 3, dtype=bool)
        for name in parts:
            k = PARTS.index(name)
            free[[where["angle"].start + k, where["length"].start + k]] = True
        if "torso" in parts:
            for name in ("shape", "center", "scale"):
                free[where[name]] = True
        return free

    def box(self, start: F64) -> Bounds:
        """Bounds around a person who starts at a vector (D,): learned for limbs, near the start for the rest."""
        where, (low, high) = self.slices(), (bound.copy() for bound in self._bounds)
        for name, reach in (("center", SHIFT * np.exp(start[-1])), ("scale", GROWTH)):
            low[where[name]], high[where[name]] = start[where[name]] - reach, start[where[name]] + reach
        low[0], high[0] = start[0] - TURN, start[0] + TURN
        inertia = np.concatenate([np.full(part.stop - part.start, INERTIA[name]) for name, part in where.items()])
        return Bounds(low, high, inertia)

    def joints(self, vectors: F64, legs: F64) -> tuple[F64, F64]:
        """Joints (P,J,2) px and scales (P,) of vectors (P,D); `legs` (J,2) px as `legs_of` gives them."""
        where = self.slices()
        angle, length = vectors[:, where["angle"]], vectors[:, where["length"]]
        scale = np.exp(vectors[:, -1])
        center = vectors[:, where["center"]]
        joints = np.empty((len(vectors), len(self.model.joint_names), 2))
        local = self._torso(vectors[:, where["shape"]])
        bone = local[:, 1, 0] - local[:, 0, 0]
        local[..., 0] *= (length[:, 0] / np.maximum(bone, 1e-6))[:, None]
        sine, cosine = np.sin(angle[:, :1]), np.cos(angle[:, :1])
        trunk = rotate(local, sine, cosine) * scale[:, None, None] + center[:, None]
        joints[:, list(self.model.part_joints[0])] = trunk
        turned = angle.copy()
        for k in range(1, len(PARTS)):
            parent = PARTS.index(self.model.tree.names[self.model.tree.parents[self.parts[k]]])
            turned[:, k] += turned[:, parent]
            near, far = self.model.part_joints[self.parts[k]][:2]
            reach = (length[:, k] * scale)[:, None]
            joints[:, far] = joints[:, near] + reach * np.column_stack([np.cos(turned[:, k]), np.sin(turned[:, k])])
        joints[..., 0] *= self._sign
        for side in ("right", "left"):
            hip = self.model.joint_names.index(f"{side}_hip")
            for below in self._below(side):
                joints[:, below] = joints[:, hip] + legs[below]
        return joints, scale

    def vectors(self, joints: F64, scale: F64) -> F64:
        """Vectors (P,D) of joints (P,J,2) px at scales (P,): elbows, wrists, face stay, shoulders follow the torso."""
        vectors = self._measured(joints, scale)
        limbs = slice(1, len(PARTS))
        middle = 0.5 * (self._bounds[0][limbs] + self._bounds[1][limbs])
        vectors[:, limbs] = (vectors[:, limbs] - middle + np.pi) % (2 * np.pi) - np.pi + middle
        return vectors

    def _measured(self, joints: F64, scale: F64) -> F64:
        """Vectors as `vectors` gives them, with angles in any turn."""
        mirrored = joints * np.array([self._sign, 1.0])
        coefficients = self.model.shape_coefficients(joints, scale, self.view)
        where = self.slices()
        vectors = np.empty((len(joints), where["scale"].stop))
        vectors[:, where["shape"]] = np.clip(coefficients[:, 0], -SHAPE, SHAPE)
        vectors[:, -1] = np.log(scale)
        neck, belly = (mirrored[:, joint] for joint in self.model.part_joints[0][:2])
        vectors[:, where["center"]] = (neck + belly) / 2
        bone = belly - neck
        vectors[:, 0] = np.arctan2(bone[:, 1], bone[:, 0])
        vectors[:, where["length"].start] = np.hypot(bone[:, 0], bone[:, 1]) / scale
        vectors[:, 1 : len(PARTS)], vectors[:, len(PARTS) + 1 : 2 * len(PARTS)] = 0.0, 0.1
        trunk = self.joints(vectors, np.zeros((joints.shape[1], 2)))[0] * np.array([self._sign, 1.0])
        placed = mirrored.copy()
        own = list(self.model.part_joints[0])
        placed[:, own] = trunk[:, own]
        turned = {0: vectors[:, 0]}
        for k in range(1, len(PARTS)):
            near, far = self.model.part_joints[self.parts[k]][:2]
            bone = placed[:, far] - placed[:, near]
            turned[self.parts[k]] = np.arctan2(bone[:, 1], bone[:, 0])
            vectors[:, k] = turned[self.parts[k]] - turned[self.model.tree.parents[self.parts[k]]]
            vectors[:, len(PARTS) + k] = np.hypot(bone[:, 0], bone[:, 1]) / scale
        return vectors

    def legs_of(self, joints: F64) -> F64:
        """Where knees, ankles and feet lie from their hip, (J,2) px, of joints (J,2); 0 of the others."""
        legs = np.zeros_like(joints)
        for side in ("right", "left"):
            for below in self._below(side):
                legs[below] = joints[below] - joints[self.model.joint_names.index(f"{side}_hip")]
        return legs

    @property
    def _sign(self) -> float:
        return 1.0 if self.view == "front" else -1.0

    def _below(self, side: str) -> list[int]:
        names = (f"{side}_{name}" for name in ("knee", "ankle", "foot"))
        return [self.model.joint_names.index(name) for name in names if name in self.model.joint_names]

    def _torso(self, shape: F64) -> F64:
        """The torso's joints (P,M,2) in its bone frame, metres, for coefficients (P,Z)."""
        torso = self.model.shapes[0]
        count = torso.joint_count
        return np.asarray(torso.mean[-count:] + np.tensordot(shape, torso.basis[-count:], axes=(1, 2)))

    def _learned_bounds(self) -> tuple[F64, F64]:
        """Bounds (D,) of limb angles and lengths from bodies drawn from the model; none for what goes all round."""
        rng = np.random.default_rng(SEED)
        joints = np.array([self.model.sample(rng).joints for _ in range(DRAWN)]) * np.array([self._sign, 1.0])
        drawn = self._measured(joints, np.ones(DRAWN))
        angles = drawn[:, 1 : len(PARTS)]
        middle = np.arctan2(np.sin(angles).mean(axis=0), np.cos(angles).mean(axis=0))
        drawn[:, 1 : len(PARTS)] = (angles - middle + np.pi) % (2 * np.pi) - np.pi + middle
        low, high = np.percentile(drawn, [TAIL, 100 - TAIL], axis=0)
        round_about = np.zeros(len(low), dtype=bool)
        round_about[1 : len(PARTS)] = (high - low)[1 : len(PARTS)] > _ALL_ROUND
        middles = np.zeros(len(low))
        middles[1 : len(PARTS)] = middle
        low, high = (
            np.where(round_about, middles - 1.5 * np.pi, low),
            np.where(round_about, middles + 1.5 * np.pi, high),
        )
        shape = self.slices()["shape"]
        low[shape], high[shape] = -SHAPE, SHAPE
        return low, high
