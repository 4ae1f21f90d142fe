# SPDX-License-Identifier: Apache-2.0
"""Headers, transforms, puppets and bodies to and from ROS messages.

The functions look at field names only, so they read rclpy messages and bag messages alike; a `MessageFactory` makes
messages of either kind.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import F64, Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.message_types import MessageFactory
from flowing_puppet_ros.units import NANOSECONDS


def header_ns(header: Any) -> int:
    """Return the stamp of a header in nanoseconds."""
    return int(header.stamp.sec) * NANOSECONDS + int(header.stamp.nanosec)


def stamp_ns(message: Any) -> int:
    """Return the header stamp of `message` in nanoseconds."""
    return header_ns(message.header)


def make_stamp(factory: MessageFactory, nanoseconds: int) -> Any:
    """Return a builtin_interfaces/Time of `nanoseconds` since the epoch."""
    seconds, rest = divmod(nanoseconds, NANOSECONDS)
    return factory.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)


def make_header(factory: MessageFactory, nanoseconds: int, frame_id: str) -> Any:
    """Return a std_msgs/Header."""
    return factory.make("std_msgs/msg/Header", stamp=make_stamp(factory, nanoseconds), frame_id=frame_id)


def make_point(factory: MessageFactory, xyz: Sequence[float] | Array) -> Any:
    """Return a geometry_msgs/Point."""
    return factory.make("geometry_msgs/msg/Point", x=float(xyz[0]), y=float(xyz[1]), z=float(xyz[2]))


def quaternion(rotation: Array) -> F64:
    """Return the unit quaternion (x, y, z, w), w >= 0, of a rotation matrix (3,3)."""
    r = np.asarray(rotation, float)
    # Bar-Itzhack's symmetric matrix: its principal eigenvector is the quaternion, also of a slightly inexact matrix.
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], r[1, 0] + r[0, 1], r[2, 0] + r[0, 2], r[2, 1] - r[1, 2]],
            [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], r[2, 1] + r[1, 2], r[0, 2] - r[2, 0]],
            [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r[0, 0] + r[1, 1] + r[2, 2]],
        ]
    )
    q = np.linalg.eigh(k)[1][:, -1]
    return q if q[3] >= 0 else -q


def rotation_matrix(q: Sequence[float] | Array) -> F64:
    """Return the rotation matrix (3,3) of a quaternion (x, y, z, w) of any length but 0."""
    length = math.sqrt(sum(float(c) ** 2 for c in q))
    if not length > 0 or not math.isfinite(length):
        raise InputError(f"the rotation ({', '.join(f'{float(c):g}' for c in q)}) is not a quaternion")
    x, y, z, w = (float(c) / length for c in q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def make_quaternion(factory: MessageFactory, rotation: Array) -> Any:
    """Return a geometry_msgs/Quaternion of a rotation matrix (3,3)."""
    x, y, z, w = (float(c) for c in quaternion(rotation))
    return factory.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def make_pose(factory: MessageFactory, position: Array, rotation: Array) -> Any:
    """Return a geometry_msgs/Pose."""
    return factory.make(
        "geometry_msgs/msg/Pose",
        position=make_point(factory, position),
        orientation=make_quaternion(factory, rotation),
    )


def make_transform(factory: MessageFactory, header: Any, child: str, position: Array, rotation: Array) -> Any:
    """Return a TransformStamped: the pose (metres) of frame `child` in the frame of `header`."""
    x, y, z = (float(c) for c in position)
    return factory.make(
        "geometry_msgs/msg/TransformStamped",
        header=header,
        child_frame_id=child,
        transform=factory.make(
            "geometry_msgs/msg/Transform",
            translation=factory.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=make_quaternion(factory, rotation),
        ),
    )


class FrameTree:
    """The static frames heard on `/tf_static`."""

    def __init__(self) -> None:
        self._parent: dict[str, tuple[str, F64, F64]] = {}

    def add(self, message: Any) -> None:
        """Take the transforms of a TFMessage; a later one replaces an earlier one of the same child.

        InputError names the first that cannot be used; the others are taken.
        """
        unusable = []
        for item in message.transforms:
            parent, child = item.header.frame_id.lstrip("/"), item.child_frame_id.lstrip("/")
            t, q = item.transform.translation, item.transform.rotation
            try:
                self._parent[child] = (parent, np.array([t.x, t.y, t.z], float), rotation_matrix((q.x, q.y, q.z, q.w)))
            except InputError as error:
                unusable.append(f"the transform from {parent!r} to {child!r} cannot be used: {error}")
        if unusable:
            raise InputError(unusable[0])

    def root(self, frame: str) -> str:
        """Return the topmost known ancestor of `frame` (itself when it has none)."""
        return self._climb(frame)[0]

    def _climb(self, frame: str) -> tuple[str, F64, F64]:
        position, rotation = np.zeros(3), np.eye(3)
        seen = {frame}
        while frame in self._parent:
            frame, step, turn = self._parent[frame]
            if frame in seen:
                raise InputError(f"the frames on /tf_static form a loop through {frame!r}")
            seen.add(frame)
            position, rotation = turn @ position + step, turn @ rotation
        return frame, position, rotation

    def pose(self, frame: str, target: str) -> tuple[F64, F64] | None:
        """Return the position (3,) and rotation (3,3) of `frame` in `target`; None when nothing connects them."""
        frame_root, position, rotation = self._climb(frame.lstrip("/"))
        target_root, target_position, target_rotation = self._climb(target.lstrip("/"))
        if frame_root != target_root:
            return None
        return target_rotation.T @ (position - target_position), target_rotation.T @ rotation
