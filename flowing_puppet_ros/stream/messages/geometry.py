# SPDX-License-Identifier: Apache-2.0
"""Stamps, headers, poses and transforms to and from ROS messages.

The functions use field names only, so they read rclpy messages and bag messages alike; a `MessageFactory` makes
messages of either kind.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import F64, Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.rotation import exp, log
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO, MessageFactory
from flowing_puppet_ros.units import NANOSECONDS

KEPT_NS = 10 * NANOSECONDS
"""Time for which the poses of a moving frame are kept."""
MAX_DISORDER_NS = 100_000_000
"""A transform whose stamp is this much before the last of its frame is that of a new recording."""


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
    return factory.make("geometry_msgs/msg/Point", x=xyz[0], y=xyz[1], z=xyz[2])


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
    w, x, y, z = _to_quaternion(np.asarray(rotation, dtype=np.float64).tolist())
    return factory.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def _to_quaternion(m: list[list[float]]) -> list[float]:
    """Return w, x, y, z, w >= 0, of one rotation matrix; `model.rotation.quaternion` is for many at a time."""
    (a, b, c), (d, e, f), (g, h, i) = m
    rows = (
        (1 + a + e + i, h - f, c - g, d - b),
        (h - f, 1 + a - e - i, b + d, c + g),
        (c - g, b + d, 1 - a + e - i, f + h),
        (d - b, c + g, f + h, 1 - a - e + i),
    )
    row = max(range(4), key=lambda k: rows[k][k])
    length = math.copysign(math.sqrt(sum(each * each for each in rows[row])), rows[row][0])
    return [each / length for each in rows[row]]


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


@dataclass(slots=True, eq=False)
class _Link:
    """A frame in its parent: poses (x, y, z, qx, qy, qz, qw) by stamp, ns, or one that always holds."""

    parent: str
    stamps: list[int]
    poses: list[tuple[float, ...]]
    is_static: bool


class FrameTree:
    """The frames received on `/tf_static`, and on `/tf` those that move, each with its poses of the last while."""

    def __init__(self) -> None:
        self._links: dict[str, _Link] = {}
        self._newest = 0

    def add(self, message: Any, moving: bool = False) -> None:
        """Add the transforms of a TFMessage; `moving` are those of `/tf`, which hold at their stamps.

        A later static one replaces an earlier one of the same child. A stamp that jumps back starts a moving frame
        anew. InputError names the first that cannot be used, after all others were added.
        """
        unusable = []
        for item in message.transforms:
            parent, child = item.header.frame_id.lstrip("/"), item.child_frame_id.lstrip("/")
            t, q = item.transform.translation, item.transform.rotation
            pose = (float(t.x), float(t.y), float(t.z), float(q.x), float(q.y), float(q.z), float(q.w))
            try:
                _check_pose(pose)
            except InputError as error:
                unusable.append(f"the transform from {parent!r} to {child!r} cannot be used: {error}")
                continue
            if not moving:
                self._links[child] = _Link(parent, [0], [pose], True)
            else:
                self._add_moving(parent, child, header_ns(item.header), pose)
        if unusable:
            raise InputError(unusable[0])

    def _add_moving(self, parent: str, child: str, stamp: int, pose: tuple[float, ...]) -> None:
        link = self._links.get(child)
        if link is not None and link.is_static:
            return
        if link is None or link.parent != parent or stamp < link.stamps[-1] - MAX_DISORDER_NS:
            link = self._links[child] = _Link(parent, [], [], False)
            self._newest = min(self._newest, stamp)
        place = bisect_left(link.stamps, stamp)
        if place < len(link.stamps) and link.stamps[place] == stamp:
            link.poses[place] = pose
        else:
            link.stamps.insert(place, stamp)
            link.poses.insert(place, pose)
        if stamp - link.stamps[0] > 2 * KEPT_NS:  # seldom, since it moves all others
            old = bisect_left(link.stamps, stamp - KEPT_NS)
            del link.stamps[:old], link.poses[:old]
        if stamp > self._newest + KEPT_NS:
            self._newest = stamp
            self._links = {name: each for name, each in self._links.items() if not _is_old(each, stamp)}

    def forget_moving(self) -> None:
        """Forget the frames that move."""
        self._links = {child: link for child, link in self._links.items() if link.is_static}

    def find_root(self, frame: str) -> str:
        """Return the topmost known ancestor of `frame`, or `frame` itself when it has none."""
        return self._list_ancestors(frame)[-1]

    def find_mount(self, frame: str) -> tuple[str, F64]:
        """Return the topmost frame to which `frame` is fixed, and the rotation (3, 3) from it to that one."""
        turn = np.eye(3)
        for each in self._list_ancestors(frame):
            link = self._links.get(each)
            if link is None or not link.is_static:
                return each, turn
            turn = _read_pose(link.poses[-1])[1] @ turn
        raise AssertionError("the last ancestor has no parent")

    def _list_ancestors(self, frame: str) -> list[str]:
        """Return a frame and its ancestors, the root last."""
        found = [frame]
        while found[-1] in self._links:
            above = self._links[found[-1]].parent
            if above in found:
                topic = "/tf_static" if all(self._links[name].is_static for name in found) else "/tf"
                raise InputError(f"the frames on {topic} form a loop through {above!r}")
            found.append(above)
        return found

    def _list_links(self, frame: str, target: str) -> tuple[list[_Link], list[_Link]] | None:
        """Return the links from two frames up to their nearest common ancestor; None when they have none."""
        own, other = self._list_ancestors(frame.lstrip("/")), self._list_ancestors(target.lstrip("/"))
        if own[-1] != other[-1]:
            return None
        while len(own) > 1 and len(other) > 1 and own[-2] == other[-2]:
            own.pop()
            other.pop()
        return [self._links[name] for name in own[:-1]], [self._links[name] for name in other[:-1]]

    def is_connected(self, frame: str, target: str) -> bool:
        """Return whether two frames belong together, whenever that is known."""
        return self._list_links(frame, target) is not None

    def is_awaited(self, frame: str, target: str, stamp: int) -> bool:
        """Return whether transforms that are yet to come may tell how two frames lie at a stamp, ns."""
        links = self._list_links(frame, target)
        return links is None or any(not link.is_static and link.stamps[-1] < stamp for link in (*links[0], *links[1]))

    def lookup_pose(self, frame: str, target: str, stamp: int | None = None) -> tuple[F64, F64] | None:
        """Return the position (3,) and rotation (3, 3) of `frame` in `target`; None when that is not known.

        Frames that move are where they are at a stamp, ns: between two stamps they move and turn evenly, and nothing
        is known before the first and after the last. Without a stamp they are where they were last.
        """
        links = self._list_links(frame, target)
        if links is None:
            return None
        poses = []
        for chain in links:
            position, turn = np.zeros(3), np.eye(3)
            for link in chain:
                pose = _find_pose(link, stamp)
                if pose is None:
                    return None
                position, turn = pose[1] @ position + pose[0], pose[1] @ turn
            poses.append((position, turn))
        (position, turn), (target_position, target_turn) = poses
        return target_turn.T @ (position - target_position), target_turn.T @ turn

    def describe_missing(self, frame: str, target: str, stamp: int) -> str:
        """Return why the pose of a frame in another is not known at a stamp, ns, and what to do."""
        frame, target = frame.lstrip("/"), target.lstrip("/")
        links = self._list_links(frame, target)
        if links is None:
            return f"/tf and /tf_static do not connect {frame!r} with {target!r}; publish or record the transform"
        moving = [link for link in (*links[0], *links[1]) if not link.is_static]
        late = max((stamp - link.stamps[-1] for link in moving), default=0)
        if late > 0:
            return (
                f"the last transform between {frame!r} and {target!r} is {late * 1e-9:.2f} s older than what it is "
                "needed for; publish it more often or sooner, or synchronise the clocks"
            )
        return f"there is no transform between {frame!r} and {target!r} as old as what it is needed for"


def _check_pose(pose: tuple[float, ...]) -> None:
    """Raise an InputError for a pose that is none."""
    if not math.isfinite(length := math.hypot(*pose[3:])) or length == 0:
        rotation_matrix(pose[3:])
    if not all(map(math.isfinite, pose[:3])):
        raise InputError(f"the translation ({', '.join(f'{c:g}' for c in pose[:3])}) is not finite")


def _is_old(link: _Link, stamp: int) -> bool:
    """Return whether nothing has been heard of a moving frame for long before a stamp, ns."""
    return not link.is_static and stamp - link.stamps[-1] > 2 * KEPT_NS


def _find_pose(link: _Link, stamp: int | None) -> tuple[F64, F64] | None:
    """Return position and rotation in the parent at a stamp, ns, or the last ones; None outside of what is known."""
    if link.is_static or stamp is None:
        return _read_pose(link.poses[-1])
    later = bisect_left(link.stamps, stamp)
    if later == len(link.stamps):
        return None
    if link.stamps[later] == stamp:
        return _read_pose(link.poses[later])
    if later == 0:
        return None
    before, after = _read_pose(link.poses[later - 1]), _read_pose(link.poses[later])
    share = (stamp - link.stamps[later - 1]) / (link.stamps[later] - link.stamps[later - 1])
    return before[0] + share * (after[0] - before[0]), before[1] @ exp(share * log(before[1].T @ after[1]))


def _read_pose(pose: tuple[float, ...]) -> tuple[F64, F64]:
    """Return the position (3,) and rotation (3, 3) of x, y, z, qx, qy, qz, qw."""
    return np.array(pose[:3]), rotation_matrix(pose[3:])
