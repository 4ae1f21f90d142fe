# SPDX-License-Identifier: Apache-2.0
"""Where sensors are when they see something: the frames of their data, which way is up there, and a fixed frame.

People are tracked in the fixed frame, so that neither a robot that drives nor a head that nods or turns moves them; its
z axis points up (REP-105). Without one they are tracked in the frame of the data, turned so that z points up. A robot's
base_footprint is on the floor (REP-120), which a sensor does not always see.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.body.scans.scan_frame import parse_axis, rotation_to_z_up
from flowing_puppet_ros.reporting import Report
from flowing_puppet_ros.stream.messages.geometry import FrameTree
from flowing_puppet_ros.stream.messages.puppets import JointPosition

OPTICAL = re.compile(r"optical(_frame)?$")
"""Frames that look along z with y down (REP-103)."""
NO_SENSOR_FRAMES = frozenset({"map", "odom", "world", "earth"})
"""Frames of REP-105 and of simulators in which no sensor stands at the origin."""
MIN_CAMERA_DISTANCE_M = 0.1
MAX_CAMERA_DISTANCE_M = 30.0
MAX_FIELD_OF_VIEW = 1.2  # tangent of half of it: 100 degrees from side to side
MIN_SENSOR_HEIGHT_M = 0.05  # over a frame that can be on the floor
ANCHOR_GRID_M = 100.0
"""Grid of the places near which coordinates are counted from, since those of a map may be large."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorPlace:
    """How the frame of some data lies in the one in which people are tracked, whose z points up.

    Attributes:
        rotation: (3, 3) and `translation` (3,) m lead from the frame of the data to that of the tracks.
        viewpoint: (3,) metres, where the sensor is in the frame of the tracks.
        to_sensor: (3, 3), from the frame of the tracks to the sensor's own with z up, however the sensor is tilted.
        is_fixed: whether people are tracked in the fixed frame.
        height: metres, of the sensor over the floor frame; None where that is not known.
    """

    rotation: F64
    translation: F64
    viewpoint: F64
    to_sensor: F64
    is_fixed: bool = False
    height: float | None = None

    def put(self, points: F64) -> F64:
        """Return points (..., 3) m of the data in the frame of the tracks."""
        return np.asarray(points @ self.rotation.T + self.translation)

    def put_joints(self, joints: dict[str, JointPosition]) -> dict[str, JointPosition]:
        """Return joints of the data in the frame of the tracks."""
        places = {name: self.put(np.array(joint[:3])) for name, joint in joints.items()}
        return {name: (float(p[0]), float(p[1]), float(p[2]), joints[name][3]) for name, p in places.items()}

    @property
    def back(self) -> tuple[F64, F64]:
        """Rotation (3, 3) and translation (3,) m from the frame of the tracks to that of the data."""
        return self.rotation.T, -self.rotation.T @ self.translation


class SensorPlaces:
    """Finds where the sensor of some data is, by the frames received on /tf and /tf_static."""

    def __init__(
        self,
        frames: FrameTree,
        up: str,
        fixed_frame: str,
        sensor_frame: str,
        report: Report,
        view: str = "auto",
        floor_frame: str = "",
    ) -> None:
        """Look frames up in `frames`; the others are the settings of these names of the body fitter."""
        self._view = view
        self._frames = frames
        self._up = up
        self._fixed, self._sensor = fixed_frame.lstrip("/"), sensor_frame.lstrip("/")
        self._floor = floor_frame.lstrip("/")
        self._is_given, self._level = bool(self._fixed), np.eye(3)
        self._report = report
        self.reset()

    def reset(self) -> None:
        """Forget the recording."""
        self._up_of_nameless = ""
        self._looked_into: set[str] = set()
        self._anchor: F64 | None = None
        self._missed = False

    @property
    def was_fixed(self) -> bool:
        """Whether the sensor's place in the fixed frame was known before."""
        return self._anchor is not None

    def is_awaited(self, frame: str, stamp: int) -> bool:
        """Return whether data of a frame and a stamp, ns, should wait for transforms that are yet to come.

        Where nothing connects the frames, only the first data wait.
        """
        pairs = [(frame, target) for target in (self._fixed, self._sensor) if target and target != frame.lstrip("/")]
        known = [(frame, self._floor)] if self._floor and self._frames.is_connected(frame, self._floor) else []
        return any(
            self._frames.is_awaited(*pair, stamp) and (self._frames.is_connected(*pair) or not self._missed)
            for pair in [*pairs, *known]
        )

    def find(self, header: Any, stamp: int, points: F64, of_depth: bool) -> SensorPlace | None:
        """Return the place of the sensor of data at a stamp, ns; None where it is not known but at other times it is.

        Where nothing connects the frames people are tracked in the frame of the data. `points` (N, 3) m are the data's,
        and `of_depth` says that they are a depth image's.
        """
        place, frame = self.find_alone(header, stamp, points, of_depth), header.frame_id.lstrip("/")
        if not self._fixed:
            return self._measure_height(place, frame, stamp)
        pose = self._frames.lookup_pose(frame, self._fixed, stamp)
        if pose is None:
            self._missed = True
            alone = self._anchor is not None or self._frames.is_connected(frame, self._fixed)
            rest = (
                "what has no place in fixed_frame is fitted by itself" if alone else "people are tracked in the former"
            )
            self._report.warn(f"{self._frames.describe_missing(frame, self._fixed, stamp)}: {rest}")
            self._report.counters["clouds without fixed_frame"] += 1
            return None if alone else self._measure_height(place, frame, stamp)
        pose = self._level @ pose[0], self._level @ pose[1]
        if self._anchor is None:
            self._anchor = ANCHOR_GRID_M * np.round(pose[0] / ANCHOR_GRID_M)
        turn = pose[1] @ place.rotation.T  # from the data's frame with z up
        shift = pose[0] - self._anchor
        fixed = SensorPlace(
            pose[1], shift, turn @ place.viewpoint + shift, place.to_sensor @ turn.T, is_fixed=True
        )  # fmt: skip
        return self._measure_height(fixed, frame, stamp)

    def fix(self, frame: str) -> str:
        """Track people in the root of a frame's tree where no fixed frame is set; return the frame of the tracks.

        The root is taken to be level; that of a rig whose transforms begin at a camera's optical frame has y down.
        """
        if self._is_given:
            return self._fixed
        root = self._frames.find_root(frame)
        if root != self._fixed:
            self._fixed, self._anchor = root, None
            self._level = rotation_to_z_up(parse_axis("-y" if OPTICAL.search(root) else "z"))
        return root

    def find_fixed(self) -> SensorPlace:
        """Return the place of the fixed frame itself in that of the tracks."""
        anchor = np.zeros(3) if self._anchor is None else self._anchor
        return SensorPlace(self._level, -anchor, np.zeros(3), np.eye(3), is_fixed=True)

    def describe_missing(self, frame: str, stamp: int) -> str:
        """Return why data of a frame have no place in the fixed frame at a stamp, ns; "" where they have one."""
        frame = frame.lstrip("/")
        if self._frames.lookup_pose(frame, self._fixed, stamp) is not None:
            return ""
        return self._frames.describe_missing(frame, self._fixed, stamp)

    def find_alone(self, header: Any, stamp: int, points: F64, of_depth: bool) -> SensorPlace:
        """Return the place of the sensor in the frame of its data, turned so that z points up."""
        own = rotation_to_z_up(parse_axis(self._find_up(header.frame_id, points, of_depth)))
        frame = header.frame_id.lstrip("/")
        mounted = self._find_mounted_up(frame)
        to_z_up = own if mounted is None else rotation_to_z_up(mounted)
        here = SensorPlace(to_z_up, np.zeros(3), np.zeros(3), own @ to_z_up.T)
        if of_depth or frame == self._sensor:
            return here
        if self._sensor:
            found = self._frames.lookup_pose(self._sensor, frame, stamp)
            if found is None:
                why = self._frames.describe_missing(self._sensor, frame, stamp)
                self._report.warn(f"{why}: the sensor is taken to be at the origin of {frame!r}")
                return here
            sensor = rotation_to_z_up(parse_axis("-y" if OPTICAL.search(self._sensor) else "z"))
            return SensorPlace(to_z_up, np.zeros(3), to_z_up @ found[0], sensor @ found[1].T @ to_z_up.T)
        one_sided = self._view == "single" and frame in NO_SENSOR_FRAMES
        if one_sided or (self._view != "full" and frame and frame == self._fixed):
            self._report.warn(
                f"the clouds are in the frame {frame!r}, and where their sensor is in it is not known: it is taken to "
                "be at the origin, where it is probably not; set sensor_frame to the sensor's own frame"
            )
        return here

    def _measure_height(self, place: SensorPlace, frame: str, stamp: int) -> SensorPlace:
        """Return a place of the sensor of data in a `frame` with its height over the floor frame, if any is known."""
        found = self._frames.lookup_pose(self._floor, frame, stamp) if self._floor else None
        height = 0.0 if found is None else float(place.viewpoint[2] - place.put(found[0])[2])
        return replace(place, height=height if height > MIN_SENSOR_HEIGHT_M else None)

    def _find_mounted_up(self, frame: str) -> F64 | None:
        """Return the direction (3,) that is up in a frame by what it is mounted on; None where it is on nothing.

        The z axis of a robot's base points up (REP-103), however a sensor is held.
        """
        if self._up != "auto":
            return None
        base, turn = self._frames.find_mount(frame)
        return None if base == frame or OPTICAL.search(base) else np.asarray(turn[2])

    def _find_up(self, frame: str, points: F64, of_depth: bool) -> str:
        """Return the axis that is up in a frame; for one without a name the first cloud decides."""
        if self._up != "auto":
            return self._up
        if of_depth or OPTICAL.search(frame):
            return "-y"
        if frame and len(points) and frame not in self._looked_into:
            self._looked_into.add(frame)
            alone = not self._fixed and self._find_mounted_up(frame) is None
            # What is farther from the sensor than any camera sees has a wrong unit, which is told elsewhere.
            if alone and is_ahead_along_z(points) and points[:, 2].min() < MAX_CAMERA_DISTANCE_M:
                self._report.warn(
                    f"the clouds in {frame!r} lie ahead along z as in the frame of a camera, but z is taken as up: name"
                    " the camera's optical frame, or set up:=-y"
                )
        if frame or not len(points):
            return "z"
        if not self._up_of_nameless:
            ahead = is_ahead_along_z(points)
            self._up_of_nameless = "-y" if ahead else "z"
            self._report.warn(
                f"the clouds have no frame_id: {self._up_of_nameless} is taken as up, since their points lie "
                f"{'ahead along z as in the frame of a camera' if ahead else 'around the origin'}; `up` sets it"
            )
        return self._up_of_nameless


def is_ahead_along_z(points: F64) -> bool:
    """Return whether (all but one in a hundred of) the points (N, 3) m lie in a cone ahead of a camera at the origin.

    In an optical frame (REP-103) all that a camera sees lies within its field of view about z. In a frame with z up the
    floor does not.
    """
    z = points[:, 2]
    inside = (z > MIN_CAMERA_DISTANCE_M) & (np.abs(points[:, :2]).max(axis=1) < MAX_FIELD_OF_VIEW * z)
    return bool(inside.mean() > 0.99)
