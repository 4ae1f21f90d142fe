# SPDX-License-Identifier: Apache-2.0
"""The kinematic skeleton of REP-155 fitted into a body: 20 joint angles, link frames, origins of joints, the mass.

Names, order and axes are those of REP-155: at zero the person stands upright with hanging limbs, x out of the chest,
y to the left, z to the head. Lengths are those of the fitted person.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from flowing_puppet_ros.body.measurements.sections import signed_volume
from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

BODY_DENSITY = 985.0
"""Of a person whose lungs hold air, kg/m3."""
RELIABLE_BEND_SINE = 0.2
"""Sine of the bend at which a limb's two bones determine the hinge's axis as reliably as the part's rotation does."""

type Axis = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class SkeletonJoint:
    """A joint, its parent link and its axis of rotation (x, y, z); None is fixed."""

    name: str
    parent: str
    axis: Axis | None = None

    @property
    def link(self) -> str:
        """The link that it moves, of the same name; but a limb's first bone is l_shoulder and not l_r_shoulder."""
        return self.name.replace("_r_shoulder", "_shoulder").replace("_r_hip", "_hip")


def _limb_joints(
    side: str, parent: str, kind: str, hinge: str, end: str, axes: tuple[tuple[float, float, float], ...]
) -> list[SkeletonJoint]:
    yaw, pitch, roll = f"{side}_y_{kind}", f"{side}_p_{kind}", f"{side}_r_{kind}"
    first = [
        SkeletonJoint(yaw, parent, axes[0]),
        SkeletonJoint(pitch, yaw, axes[1]),
        SkeletonJoint(roll, pitch, axes[2]),
    ]
    return [
        *first,
        SkeletonJoint(f"{side}_{hinge}", first[-1].link, (0, -1, 0)),
        SkeletonJoint(f"{side}_{end}", f"{side}_{hinge}"),
    ]


def _arm_joints(side: str, sign: float) -> list[SkeletonJoint]:
    axes = (0.0, 0.0, -sign), (sign, 0.0, 0.0), (0.0, 0.0, sign)
    return _limb_joints(side, "torso", "shoulder", "elbow", "wrist", axes)


def _leg_joints(side: str, sign: float) -> list[SkeletonJoint]:
    axes = (0.0, 0.0, -1.0), (sign, 0.0, 0.0), (0.0, -1.0, 0.0)
    return _limb_joints(side, "body", "hip", "knee", "ankle", axes)


JOINTS = (
    SkeletonJoint("waist", "body", (0, 1, 0)),
    SkeletonJoint("torso", "waist"),
    SkeletonJoint("r_head", "torso", (1, 0, 0)),
    SkeletonJoint("y_head", "r_head", (0, 0, 1)),
    SkeletonJoint("p_head", "y_head", (0, -1, 0)),
    SkeletonJoint("head", "p_head"),
    *_arm_joints("l", 1.0),
    *_arm_joints("r", -1.0),
    *_leg_joints("l", 1.0),
    *_leg_joints("r", -1.0),
)
"""All joints, parents before children; `body` is the root."""
MOVING_JOINTS = tuple(joint.name for joint in JOINTS if joint.axis is not None)
"""The 20 revolute joints in the order of REP-155's reference producer."""
_SIDES = {"l": "left", "r": "right"}
_LIMBS = {"shoulder": ("shoulder", "elbow", "wrist", "upper_arm"), "hip": ("hip", "knee", "ankle", "upper_leg")}
"""First, second and third joint of a limb, and the part between the first two."""

LinkFrame = tuple[np.ndarray, np.ndarray]
"""Position (3,) in metres and rotation (3, 3)."""


class Skeleton:
    """The REP-155 skeleton of the people of one body model."""

    def __init__(self, model: StitchedPuppet) -> None:
        self._model = model
        self._index = {name: row for row, name in enumerate(model.joint_names)}
        self._rest = self._joints_at_rest(np.zeros((len(model.tree), model.shape_count)))
        self._hinges = {(side, kind): self._hinge_at_rest(self._rest, side, kind) for side in _SIDES for kind in _LIMBS}

    def body_frame(self, joints: np.ndarray, state: BodyState) -> LinkFrame:
        """Return REP-155's `body_<id>`: origin between the hips, axes of the torso (x forward, z to the head)."""
        return self._hip_centre(joints), state.rotation[0]

    def joint_origins(self, shape: np.ndarray) -> dict[str, np.ndarray]:
        """Return each joint's position (3,) in its parent link, metres, for a person of `shape` (16, S)."""
        joints = self._joints_at_rest(shape)
        middle, torso = self._hip_centre(joints), self._model.rest_center[0]
        head = self._model.rest_center[self._model.tree.index("head")]
        found = {joint.name: np.zeros(3) for joint in JOINTS}
        found |= {"torso": torso - middle, "r_head": self._joint(joints, "neck") - torso}
        found["head"] = head - self._joint(joints, "neck")
        for short, side in _SIDES.items():
            for kind, (first, second, third, _) in _LIMBS.items():
                a, b, c = (self._joint(joints, f"{side}_{name}") for name in (first, second, third))
                found[f"{short}_y_{kind}"] = a - (torso if kind == "shoulder" else middle)
                found[f"{short}_{second}"] = np.array([0.0, 0.0, -np.linalg.norm(b - a)])
                found[f"{short}_{third}"] = np.array([0.0, 0.0, -np.linalg.norm(c - b)])
        return found

    def mass(self, shape: np.ndarray) -> float:
        """Return the mass in kg of a person of `shape` (16, S): that of the volume of their body at rest."""
        vertices = self._model.vertices(replace(self._model.rest_state(), shape=shape))
        return BODY_DENSITY * signed_volume(vertices, self._model.faces)

    def joint_angles(self, joints: np.ndarray, state: BodyState) -> dict[str, float]:
        """Return the angles (radians) of the 20 moving joints by name, in the order of `MOVING_JOINTS`.

        The bones follow from `joints` (J, 3); the twist of the limbs, the head and the torso follow from the rotations
        of the parts in `state`.
        """
        body = state.rotation[0]
        bend = self._torso_lean(joints, body) - self._torso_lean(self._rest, np.eye(3))
        chest = body @ rotation.exp(np.array([0.0, bend, 0.0]))
        head = chest.T @ state.rotation[self._model.tree.index("head")]
        # Euler angles about the positive axes; those of the joints may point the other way.
        angles = {"waist": bend, **dict(zip(("r_head", "y_head", "p_head"), _euler_angles(head, "XZY"), strict=True))}
        for short, side in _SIDES.items():
            angles |= self._limb_angles(short, side, "shoulder", "ZXZ", chest, joints, state)
            angles |= self._limb_angles(short, side, "hip", "ZXY", body, joints, state)
        signs = {joint.name: float(sum(joint.axis)) for joint in JOINTS if joint.axis is not None}
        return {name: angles[name] * signs[name] for name in MOVING_JOINTS}

    def _limb_angles(
        self, short: str, side: str, kind: str, order: str, parent: np.ndarray, joints: np.ndarray, state: BodyState
    ) -> dict[str, float]:
        first, second, third, part = _LIMBS[kind]
        a, b, c = (self._joint(joints, f"{side}_{name}") for name in (first, second, third))
        upper, lower = _unit(b - a), _unit(c - b)
        own = state.rotation[self._model.tree.index(f"{side}_{part}")]
        hinge = RELIABLE_BEND_SINE * own @ self._hinges[short, kind] + self._bend_axis(upper, lower, kind)
        hinge = _unit(hinge - upper * (upper @ hinge))
        axes = np.stack([np.cross(hinge, -upper), hinge, -upper], axis=1)
        local = parent.T @ axes
        if short == "r" and kind == "shoulder":
            # Mirrored to a left arm, so that both arms are raised by a positive angle.
            mirror = np.diag([1.0, -1.0, 1.0])
            yaw, pitch, roll = (-angle for angle in _euler_angles(mirror @ local @ mirror, order))
        else:
            yaw, pitch, roll = _euler_angles(local, order)
        # About the hinge, which is y: an elbow flexes the forearm forward, a knee the shank backward.
        flexion = math.atan2(np.cross(upper, lower) @ hinge, upper @ lower)
        names = f"{short}_y_{kind}", f"{short}_p_{kind}", f"{short}_r_{kind}", f"{short}_{second}"
        return dict(zip(names, (yaw, pitch, roll, flexion), strict=True))

    def _hinge_at_rest(self, joints: np.ndarray, side: str, kind: str) -> np.ndarray:
        """Return y (3,) of a limb's upper link for a body at rest, where all parts have the axes of the body."""
        first, second, third, _ = _LIMBS[kind]
        a, b, c = (self._joint(joints, f"{_SIDES[side]}_{name}") for name in (first, second, third))
        return _unit(self._bend_axis(_unit(b - a), _unit(c - b), kind))

    @staticmethod
    def _bend_axis(upper: np.ndarray, lower: np.ndarray, kind: str) -> np.ndarray:
        """Return y of a limb's upper link from the directions of both bones; its length is the sine of the bend."""
        across = np.cross(upper, lower)
        return -across if kind == "shoulder" else across

    def _torso_lean(self, joints: np.ndarray, body: np.ndarray) -> float:
        """Return the forward lean in radians of the line from hips to neck, in the frame of the torso."""
        along = body.T @ (self._joint(joints, "neck") - self._hip_centre(joints))
        return math.atan2(along[0], along[2])

    def _joints_at_rest(self, shape: np.ndarray) -> np.ndarray:
        return self._model.joints(self._model.vertices(replace(self._model.rest_state(), shape=shape)))

    def _hip_centre(self, joints: np.ndarray) -> np.ndarray:
        return np.asarray((self._joint(joints, "left_hip") + self._joint(joints, "right_hip")) / 2)

    def _joint(self, joints: np.ndarray, name: str) -> np.ndarray:
        return np.asarray(joints[self._index[name]])


def link_frames(origins: Mapping[str, np.ndarray], angles: Mapping[str, float]) -> dict[str, LinkFrame]:
    """Return the frame of every link in the frame of `body`, by forward kinematics."""
    frames: dict[str, LinkFrame] = {"body": (np.zeros(3), np.eye(3))}
    for joint in JOINTS:
        position, orientation = frames[joint.parent]
        own = np.eye(3) if joint.axis is None else rotation.exp(angles[joint.name] * np.array(joint.axis, float))
        frames[joint.link] = position + orientation @ origins[joint.name], orientation @ own
    return frames


def _unit(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-9))


def _euler_angles(matrix: np.ndarray, order: str) -> tuple[float, float, float]:
    """Return the angles about the positive axes, in the order of the joints from the trunk outwards."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # where the first and third axis coincide the third angle is 0
        a, b, c = Rotation.from_matrix(matrix).as_euler(order)
    return float(a), float(b), float(c)
