# SPDX-License-Identifier: Apache-2.0
"""A person as a URDF by REP-155: links as cylinders with the masses of body segments, joints with their limits.

Viewers need the shapes; planners and simulators also collisions, limits and inertias.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from xml.sax.saxutils import quoteattr

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.stream.messages.bodies.ros4hri_skeleton import BODY_DENSITY, JOINTS

DRAWN_RADIUS_M, HEAD_RADIUS_M = 0.03, 0.1
"""Of the bones and the head as viewers draw them."""
_LIMBS = {"shoulder": 0.028, "elbow": 0.016, "wrist": 0.006, "hip": 0.1, "knee": 0.0465, "ankle": 0.0145}
SEGMENTS = {"head": 0.081, "torso": 0.497} | {
    f"{side}_{name}": share for name, share in _LIMBS.items() for side in "lr"
}
"""Share of a person's mass by the link that carries a segment (Winter, Biomechanics of Human Movement, table 4.1)."""
LIMITS = {
    "waist": (-0.6, 1.6), "r_head": (-0.9, 0.9), "y_head": (-1.6, 1.6), "p_head": (-1.2, 1.2),
    "p_shoulder": (0.0, math.pi), "elbow": (-0.2, 2.7), "p_hip": (-math.pi / 2, math.pi / 2), "knee": (-2.7, 0.2),
}  # fmt: skip
"""Radians. Of the three turns of a shoulder or hip the outer ones have none: together they reach every direction."""
FREE = (-math.pi, math.pi)
MAX_TORQUE_NM, MAX_SPEED_RAD_PER_S = 300.0, 25.0
"""Of knees in jumps and of elbows in throws."""


def make_urdf(identity: str, origins: Mapping[str, F64], mass: float) -> str:
    """Return the person's URDF: links and joints of `JOINTS`, names ending in `_<identity>`.

    Args:
        identity: of the person, as a component of a topic's name.
        origins: joint -> its position (3,) in its parent link, metres.
        mass: of the person, kg; the root link has none of it, as is usual in ROS.
    """
    lines = ['<?xml version="1.0"?>', f"<robot name={quoteattr('human_' + identity)}>"]
    lines.append(f"  <link name={quoteattr('body_' + identity)}/>")
    bones: dict[str, list[F64]] = {}
    for joint in JOINTS:
        bones.setdefault(joint.parent, []).append(origins[joint.name])
    for joint in JOINTS:
        own = bones.get(joint.link, [])
        inertial = _make_inertial(joint.link, own, origins, mass)
        shapes = _make_shapes(own, ball=joint.link == "head")
        lines += _make_link(f"{joint.link}_{identity}", [*shapes, *inertial])
        x, y, z = origins[joint.name]
        kind = "fixed" if joint.axis is None else "revolute"
        lines.append(f'  <joint name={quoteattr(f"{joint.name}_{identity}")} type="{kind}">')
        lines.append(f"    <parent link={quoteattr(f'{joint.parent}_{identity}')}/>")
        lines.append(f"    <child link={quoteattr(f'{joint.link}_{identity}')}/>")
        lines.append(f'    <origin xyz="{x:.4f} {y:.4f} {z:.4f}" rpy="0 0 0"/>')
        if joint.axis is not None:
            low, high = find_limits(joint.name)
            lines.append('    <axis xyz="{:g} {:g} {:g}"/>'.format(*joint.axis))
            lines.append(
                f'    <limit lower="{low:.4f}" upper="{high:.4f}" effort="{MAX_TORQUE_NM:g}"'
                f' velocity="{MAX_SPEED_RAD_PER_S:g}"/>'
            )
        lines.append("  </joint>")
    return "\n".join([*lines, "</robot>", ""])


def find_limits(joint: str) -> tuple[float, float]:
    """Return the lowest and the highest angle of a joint in radians."""
    return LIMITS.get(joint, LIMITS.get(joint.partition("_")[2], FREE))


def _make_link(name: str, content: list[str]) -> list[str]:
    if not content:
        return [f"  <link name={quoteattr(name)}/>"]
    return [f"  <link name={quoteattr(name)}>", *(f"    {line}" for line in content), "  </link>"]


def _make_shapes(bones: list[F64], ball: bool) -> list[str]:
    """Return what is seen of a link and what is collided with, which are the same."""
    shapes = []
    if ball:
        shapes.append(f'<origin xyz="0 0 0" rpy="0 0 0"/><geometry><sphere radius="{HEAD_RADIUS_M:g}"/></geometry>')
    for bone in bones:
        length = float(np.linalg.norm(bone))
        if length > 0.01:
            cylinder = f'<cylinder length="{length:.4f}" radius="{DRAWN_RADIUS_M:g}"/>'
            shapes.append(f"{_make_origin(bone / 2, bone)}<geometry>{cylinder}</geometry>")
    return [f"<{tag}>{shape}</{tag}>" for tag in ("visual", "collision") for shape in shapes]


def _make_origin(center: F64, along: F64) -> str:
    """Return the origin of a cylinder about `along` (3,): it lies along z, and is turned about y, then about z."""
    pitch = np.arccos(np.clip(along[2] / np.linalg.norm(along), -1, 1))
    yaw = np.arctan2(along[1], along[0])
    x, y, z = center
    return f'<origin xyz="{x:.4f} {y:.4f} {z:.4f}" rpy="0 {pitch:.4f} {yaw:.4f}"/>'


def _make_inertial(name: str, bones: list[F64], origins: Mapping[str, F64], total: float) -> list[str]:
    """Return the inertia of the segment that a link carries: a cylinder's, or a ball's where there is no bone."""
    if name not in SEGMENTS:
        return []
    mass = SEGMENTS[name] * total
    start, end = np.zeros(3), bones[0] if bones else np.zeros(3)
    if name == "torso":
        start, end = -origins["torso"], origins["r_head"]  # from between the hips to the neck
    along = end - start
    length = float(np.linalg.norm(along))
    if length > 0.01:
        square = mass / (BODY_DENSITY * np.pi * length)
        across, own = mass * (square / 4 + length**2 / 12), mass * square / 2
        origin = _make_origin((start + end) / 2, along)
    else:
        across = own = 0.4 * mass * (3 * mass / (4 * np.pi * BODY_DENSITY)) ** (2 / 3)
        origin = '<origin xyz="0 0 0" rpy="0 0 0"/>'
    moments = f'ixx="{across:.6f}" ixy="0" ixz="0" iyy="{across:.6f}" iyz="0" izz="{own:.6f}"'
    return [f'<inertial>{origin}<mass value="{mass:.3f}"/><inertia {moments}/></inertial>']
