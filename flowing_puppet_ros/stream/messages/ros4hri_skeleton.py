# SPDX-License-Identifier: Apache-2.0
"""The kinematic skeleton of REP-155 laid into a fitted body: 20 joint angles, link frames and a URDF.

Names, order and axes are those that consumers of REP-155 know: at zero the person stands upright with hanging limbs,
x out of the chest, y to the left, z to the head. Lengths are the fitted person's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation

from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

# Bend at which the other bone of a limb tells the hinge's axis as surely as the turn of the part does (sine).
SURE_BEND = 0.2


type Axis = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Joint:
    """A joint with the link of the same name, its parent link, and the axis (x, y, z) it turns about; None is fixed."""

    name: str
    parent: str
    axis: Axis | None = None


def _limb(
    side: str, parent: str, kind: str, hinge: str, end: str, axes: tuple[tuple[float, float, float], ...]
) -> list[Joint]:
    yaw, pitch, roll = f"{side}_y_{kind}", f"{side}_p_{kind}", f"{side}_r_{kind}"
    first = [Joint(yaw, parent, axes[0]), Joint(pitch, yaw, axes[1]), Joint(roll, pitch, axes[2])]
    return [*first, Joint(f"{side}_{hinge}", roll, (0, -1, 0)), Joint(f"{side}_{end}", f"{side}_{hinge}")]


def _arm(side: str, sign: float) -> list[Joint]:
    axes = (0.0, 0.0, -sign), (sign, 0.0, 0.0), (0.0, 0.0, sign)
    return _limb(side, "torso", "shoulder", "elbow", "wrist", axes)


def _leg(side: str, sign: float) -> list[Joint]:
    axes = (0.0, 0.0, -1.0), (sign, 0.0, 0.0), (0.0, -1.0, 0.0)
    return _limb(side, "body", "hip", "knee", "ankle", axes)


JOINTS = (
    Joint("waist", "body", (0, 1, 0)),
    Joint("torso", "waist"),
    Joint("r_head", "torso", (1, 0, 0)),
    Joint("y_head", "r_head", (0, 0, 1)),
    Joint("p_head", "y_head", (0, -1, 0)),
    Joint("head", "p_head"),
    *_arm("l", 1.0),
    *_arm("r", -1.0),
    *_leg("l", 1.0),
    *_leg("r", -1.0),
)
"""All joints, parents before children; `body` is the root."""
MOVING = tuple(joint.name for joint in JOINTS if joint.axis is not None)
"""The 20 joints that turn, in the order of REP-155's reference producer."""
_SIDES = {"l": "left", "r": "right"}
_LIMBS = {"shoulder": ("shoulder", "elbow", "wrist", "upper_arm"), "hip": ("hip", "knee", "ankle", "upper_leg")}
"""First, second and third joint of a limb, and the part that lies between the first two."""

Frame = tuple[np.ndarray, np.ndarray]
"""Position (3,) in metres and rotation (3, 3)."""


class Skeleton:
    """The skeleton of the people of one body model."""

    def __init__(self, model: StitchedPuppet) -> None:
        self._model = model
        self._index = {name: row for row, name in enumerate(model.joint_names)}
        self._rest = self._at_rest(np.zeros((len(model.tree), model.shape_count)))
        self._hinges = {(side, kind): self._hinge(self._rest, side, kind) for side in _SIDES for kind in _LIMBS}

    def body_frame(self, joints: np.ndarray, state: BodyState) -> Frame:
        """`body_<id>` of REP-155: origin between the hips, axes of the torso (x out of the chest, z to the head)."""
        return self._middle(joints), state.rotation[0]

    def origins(self, shape: np.ndarray) -> dict[str, np.ndarray]:
        """Where (3,) each joint sits in its parent link for a person of `shape` (16, S), metres."""
        joints = self._at_rest(shape)
        middle, torso = self._middle(joints), self._model.rest_center[0]
        head = self._model.rest_center[self._model.tree.index("head")]
        found = {joint.name: np.zeros(3) for joint in JOINTS}
        found |= {"torso": torso - middle, "r_head": self._of(joints, "neck") - torso}
        found["head"] = head - self._of(joints, "neck")
        for short, side in _SIDES.items():
            for kind, (first, second, third, _) in _LIMBS.items():
                a, b, c = (self._of(joints, f"{side}_{name}") for name in (first, second, third))
                found[f"{short}_y_{kind}"] = a - (torso if kind == "shoulder" else middle)
                found[f"{short}_{second}"] = np.array([0.0, 0.0, -np.linalg.norm(b - a)])
                found[f"{short}_{third}"] = np.array([0.0, 0.0, -np.linalg.norm(c - b)])
        return found

    def angles(self, joints: np.ndarray, state: BodyState) -> dict[str, float]:
        """Angles (radians) of the 20 moving joints of a body with joints (J, 3), by name in the order of `MOVING`.

        Bones point from joint to joint; how a limb is turned about itself, the head and the torso come from the
        rotations of the parts.
        """
        body = state.rotation[0]
        bend = self._bend(joints, body) - self._bend(self._rest, np.eye(3))
        chest = body @ rotation.exp(np.array([0.0, bend, 0.0]))
        head = chest.T @ state.rotation[self._model.tree.index("head")]
        # Euler angles about the positive axes; those of the joints may point the other way.
        turned = {"waist": bend, **dict(zip(("r_head", "y_head", "p_head"), _euler(head, "XZY"), strict=True))}
        for short, side in _SIDES.items():
            turned |= self._limb_angles(short, side, "shoulder", "ZXZ", chest, joints, state)
            turned |= self._limb_angles(short, side, "hip", "ZXY", body, joints, state)
        signs = {joint.name: float(sum(joint.axis)) for joint in JOINTS if joint.axis is not None}
        return {name: turned[name] * signs[name] for name in MOVING}

    def _limb_angles(
        self, short: str, side: str, kind: str, order: str, parent: np.ndarray, joints: np.ndarray, state: BodyState
    ) -> dict[str, float]:
        first, second, third, part = _LIMBS[kind]
        a, b, c = (self._of(joints, f"{side}_{name}") for name in (first, second, third))
        upper, lower = _unit(b - a), _unit(c - b)
        own = state.rotation[self._model.tree.index(f"{side}_{part}")]
        hinge = SURE_BEND * own @ self._hinges[short, kind] + self._bent(upper, lower, kind)
        hinge = _unit(hinge - upper * (upper @ hinge))
        axes = np.stack([np.cross(hinge, -upper), hinge, -upper], axis=1)
        local = parent.T @ axes
        if short == "r" and kind == "shoulder":
            # As the left arm in the mirror, so that both raise their arms by a positive angle.
            mirror = np.diag([1.0, -1.0, 1.0])
            first_turn, raised, roll = (-angle for angle in _euler(mirror @ local @ mirror, order))
        else:
            first_turn, raised, roll = _euler(local, order)
        # About the hinge, which is y: an elbow folds the forearm forward, a knee the shank backward.
        fold = math.atan2(np.cross(upper, lower) @ hinge, upper @ lower)
        names = f"{short}_y_{kind}", f"{short}_p_{kind}", f"{short}_r_{kind}", f"{short}_{second}"
        return dict(zip(names, (first_turn, raised, roll, fold), strict=True))

    def _hinge(self, joints: np.ndarray, side: str, kind: str) -> np.ndarray:
        """Y (3,) of a limb's upper link for a body at rest, where all parts have the axes of the body."""
        first, second, third, _ = _LIMBS[kind]
        a, b, c = (self._of(joints, f"{_SIDES[side]}_{name}") for name in (first, second, third))
        return _unit(self._bent(_unit(b - a), _unit(c - b), kind))

    @staticmethod
    def _bent(upper: np.ndarray, lower: np.ndarray, kind: str) -> np.ndarray:
        """Y of a limb's upper link, as long as the sine of the bend, from the directions of both bones."""
        across = np.cross(upper, lower)
        return -across if kind == "shoulder" else across

    def _bend(self, joints: np.ndarray, body: np.ndarray) -> float:
        """How far the line from the hips to the neck leans forward in the frame of the torso, radians."""
        along = body.T @ (self._of(joints, "neck") - self._middle(joints))
        return math.atan2(along[0], along[2])

    def _at_rest(self, shape: np.ndarray) -> np.ndarray:
        return self._model.joints(self._model.vertices(replace(self._model.rest_state(), shape=shape)))

    def _middle(self, joints: np.ndarray) -> np.ndarray:
        return np.asarray((self._of(joints, "left_hip") + self._of(joints, "right_hip")) / 2)

    def _of(self, joints: np.ndarray, name: str) -> np.ndarray:
        return np.asarray(joints[self._index[name]])


def link_frames(origins: Mapping[str, np.ndarray], angles: Mapping[str, float]) -> dict[str, Frame]:
    """Where every link is in the frame of `body`, by forward kinematics."""
    placed: dict[str, Frame] = {"body": (np.zeros(3), np.eye(3))}
    for joint in JOINTS:
        position, turn = placed[joint.parent]
        own = np.eye(3) if joint.axis is None else rotation.exp(angles[joint.name] * np.array(joint.axis, float))
        placed[joint.name] = position + turn @ origins[joint.name], turn @ own
    return placed


def urdf(identity: str, origins: Mapping[str, np.ndarray]) -> str:
    """The person as URDF: links and joints of `JOINTS`, each name followed by `_<identity>`; bones are cylinders."""
    lines = ['<?xml version="1.0"?>', f"<robot name={quoteattr('human_' + identity)}>"]
    lines.append(f"  <link name={quoteattr('body_' + identity)}/>")
    bones: dict[str, list[np.ndarray]] = {}
    for joint in JOINTS:
        bones.setdefault(joint.parent, []).append(origins[joint.name])
    for joint in JOINTS:
        lines += _link(f"{joint.name}_{identity}", bones.get(joint.name, []), ball=joint.name == "head")
        x, y, z = origins[joint.name]
        kind = "fixed" if joint.axis is None else "revolute"
        lines.append(f'  <joint name={quoteattr(f"{joint.name}_{identity}")} type="{kind}">')
        lines.append(f"    <parent link={quoteattr(f'{joint.parent}_{identity}')}/>")
        lines.append(f"    <child link={quoteattr(f'{joint.name}_{identity}')}/>")
        lines.append(f'    <origin xyz="{x:.4f} {y:.4f} {z:.4f}" rpy="0 0 0"/>')
        if joint.axis is not None:
            lines.append('    <axis xyz="{:g} {:g} {:g}"/>'.format(*joint.axis))
            lines.append('    <limit lower="-3.1416" upper="3.1416" effort="0" velocity="0"/>')
        lines.append("  </joint>")
    return "\n".join([*lines, "</robot>", ""])


def _link(name: str, bones: list[np.ndarray], ball: bool) -> list[str]:
    long = [bone for bone in bones if np.linalg.norm(bone) > 0.01]
    shapes = ['<origin xyz="0 0 0" rpy="0 0 0"/><geometry><sphere radius="0.1"/></geometry>'] if ball else []
    for bone in long:
        length = float(np.linalg.norm(bone))
        x, y, z = bone / 2
        # A cylinder lies along z: tilted about y, then turned about z.
        tilt, turn = np.arccos(np.clip(bone[2] / length, -1, 1)), np.arctan2(bone[1], bone[0])
        where = f'<origin xyz="{x:.4f} {y:.4f} {z:.4f}" rpy="0 {tilt:.4f} {turn:.4f}"/>'
        shapes.append(f'{where}<geometry><cylinder length="{length:.4f}" radius="0.03"/></geometry>')
    if not shapes:
        return [f"  <link name={quoteattr(name)}/>"]
    visuals = [f"    <visual>{shape}</visual>" for shape in shapes]
    return [f"  <link name={quoteattr(name)}>", *visuals, "  </link>"]


def _unit(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-9))


def _euler(turn: np.ndarray, order: str) -> tuple[float, float, float]:
    """Angles about the positive axes, in the order in which the joints follow from the trunk outwards."""
    a, b, c = Rotation.from_matrix(turn).as_euler(order, suppress_warnings=True)
    return float(a), float(b), float(c)
