# SPDX-License-Identifier: Apache-2.0
"""Stamps, headers, poses and transforms to and from ROS messages.

The functions use field names only, so they read rclpy messages and bag messages alike; a `MessageFactory` makes
messages of either kind.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import F64, Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.rotation import quaternion
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO, MessageFactory
from flowing_puppet_ros.units import NANOSECONDS


def header_ns(header: Any) -> int:
    """Return the stamp of a header in nanoseconds."""
    return int(header.stamp.sec) * NANOSECONDS + int(header.stamp.nanosec)


def stamp_ns(message: Any) -> int:
    """Return the header stamp of `message` in nanoseconds."""
    return header_ns(message.header)


def make_stamp(factory: MessageFactory, nanoseconds: int) -> Any:
    """Return the builtin_interfaces/Time of `nanoseconds` since the epoch."""
    seconds, rest = divmod(nanoseconds, NANOSECONDS)
    return factory.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)


def make_header(factory: MessageFactory, nanoseconds: int, frame_id: str) -> Any:
    """Return a std_msgs/Header."""
    return factory.make("std_msgs/msg/Header", stamp=make_stamp(factory, nanoseconds), frame_id=frame_id)


def make_point(factory: MessageFactory, xyz: Sequence[float] | Array) -> Any:
    """Return a geometry_msgs/Point."""
    return factory.make("geometry_msgs/msg/Point", x=float(xyz[0]), y=float(xyz[1]), z=float(xyz[2]))


def make_vector(factory: MessageFactory, xyz: Sequence[float] | Array) -> Any:
    """Return a geometry_msgs/Vector3."""
    return factory.make("geometry_msgs/msg/Vector3", x=float(xyz[0]), y=float(xyz[1]), z=float(xyz[2]))


def rotation_matrix(q: Sequence[float] | Array) -> F64:
    """Return the rotation matrix (3, 3) of a quaternion (x, y, z, w) of any non-zero length; InputError otherwise."""
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
    """Return the geometry_msgs/Quaternion of a rotation matrix (3, 3)."""
    w, x, y, z = (float(c) for c in quaternion(rotation))
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
    return factory.make(
        "geometry_msgs/msg/TransformStamped",
        header=header,
        child_frame_id=child,
        transform=factory.make(
            "geometry_msgs/msg/Transform",
            translation=make_vector(factory, position),
            rotation=make_quaternion(factory, rotation),
        ),
    )


def make_camera_info(
    factory: MessageFactory, header: Any, size: tuple[int, int], matrix: Array, distortion: Array
) -> Any:
    """Return the CameraInfo of a camera of `size` (width, height) px with its `matrix` (3, 3) and `distortion` (D,)."""
    return factory.make(
        CAMERA_INFO,
        header=header,
        height=size[1],
        width=size[0],
        distortion_model="plumb_bob",
        d=distortion,
        k=matrix,
        r=np.eye(3),
        p=np.hstack([matrix, np.zeros((3, 1))]),
    )


class FrameTree:
    """The static frames received on `/tf_static`."""

    def __init__(self) -> None:
        self._parent: dict[str, tuple[str, F64, F64]] = {}

    def add(self, message: Any) -> None:
        """Add the transforms of a TFMessage; a later one replaces an earlier one of the same child.

        InputError names the first that cannot be used, after all others were added.
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

    def find_root(self, frame: str) -> str:
        """Return the topmost known ancestor of `frame`, or `frame` itself when it has none."""
        return self._pose_in_root(frame)[0]

    def _pose_in_root(self, frame: str) -> tuple[str, F64, F64]:
        position, rotation = np.zeros(3), np.eye(3)
        seen = {frame}
        while frame in self._parent:
            frame, parent_position, parent_rotation = self._parent[frame]
            if frame in seen:
                raise InputError(f"the frames on /tf_static form a loop through {frame!r}")
            seen.add(frame)
            position, rotation = parent_rotation @ position + parent_position, parent_rotation @ rotation
        return frame, position, rotation

    def lookup_pose(self, frame: str, target: str) -> tuple[F64, F64] | None:
        """Return the position (3,) and rotation (3, 3) of `frame` in `target`; None when they are not connected."""
        frame_root, position, rotation = self._pose_in_root(frame.lstrip("/"))
        target_root, target_position, target_rotation = self._pose_in_root(target.lstrip("/"))
        if frame_root != target_root:
            return None
        return target_rotation.T @ (position - target_position), target_rotation.T @ rotation
