# SPDX-License-Identifier: Apache-2.0
"""Puppets of a colour camera for the clouds of another sensor: paired by stamp, carried to it, in the cloud's frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.fusion.people_fitter import FusionSettings
from flowing_puppet_ros.fusion.puppet_joints import PuppetJoints, carry_puppets, place_joints
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.reporting import Report
from flowing_puppet_ros.stream.messages.camera_info import describe_images
from flowing_puppet_ros.stream.messages.geometry import FrameTree, stamp_ns
from flowing_puppet_ros.stream.messages.puppets import decode_puppet_joints
from flowing_puppet_ros.stream.pairing.person_masks import add_masks
from flowing_puppet_ros.stream.pairing.time_synchronizer import BACKWARD_JUMP_NS

MAX_KEPT = 120  # messages of puppets
MAX_OUTSIDE, MIN_OUTSIDE_CONFIDENCE = 0.1, 0.5
"""Of the image's size, by which a joint of that confidence lies outside of an image that it cannot be of."""
_ARMS = {"wrist": "lower_arm", "hand": "hand", "elbow": "upper_arm"}


@dataclass(frozen=True, slots=True, eq=False)
class PairedPuppets:
    """The puppets at the time of a cloud, and the camera that saw them, in the frame of the cloud."""

    camera: Camera
    puppets: list[PuppetJoints]


class PuppetPairs:
    """Keeps what came of a colour camera until the clouds that it belongs to are there."""

    def __init__(
        self,
        model: StitchedPuppet,
        settings: FusionSettings,
        frames: FrameTree | None = None,
        report: Report | None = None,
    ) -> None:
        """Read joints for the body `model`; `frames` take what comes on /tf and /tf_static."""
        self._report = report or Report()
        self._model = model
        self._settings = settings
        self._frames = frames or FrameTree()
        self._info: Any = None
        self.reset()

    def reset(self) -> None:
        """Drop the puppets; keep calibration and frames."""
        self._messages: list[tuple[int, Any]] = []
        self._masks: dict[int, Any] = {}
        self._newest_mask: int | None = None  # or of the first puppets, before any has come

    def add(self, port: str, message: Any) -> None:
        """Take a message of `puppets`, `person_masks`, `puppets/camera_info`, /tf_static or /tf.

        Raises:
            InputError: when it cannot be used.
        """
        if port in ("/tf_static", "/tf"):
            self._frames.add(message, moving=port == "/tf")
        elif port == "puppets/camera_info":
            self._info = message
        elif port == "person_masks":
            self._newest_mask = stamp_ns(message)
            self._masks[self._newest_mask] = message
            for stamp in sorted(self._masks)[:-MAX_KEPT]:
                del self._masks[stamp]
        else:
            stamp = stamp_ns(message)
            if self._messages and stamp < self._messages[-1][0] - BACKWARD_JUMP_NS:
                self._messages = []
            self._messages = sorted([*self._messages, (stamp, message)], key=lambda pair: pair[0])[-MAX_KEPT:]

    @property
    def is_calibrated(self) -> bool:
        """Whether the calibration of the puppets' camera has come."""
        return self._info is not None

    def is_awaited(self, first: int, last: int) -> bool:
        """Return whether puppets will soon come for clouds of the stamps from `first` to `last`, nanoseconds."""
        newest = self._messages[-1][0] if self._messages else first
        return (last - newest) * 1e-9 <= self._settings.wait

    def is_ready(self, frame: str, stamp: int, masked: bool = False) -> bool:
        """Return whether no later message of puppets, masks or transforms can change what `find` tells of a cloud.

        `frame` and `stamp`, nanoseconds, are the cloud's, and `masked` is whether masks are expected.
        """
        if not self._messages or self._messages[-1][0] < stamp:
            return False
        if masked and self._is_mask_awaited(next(each for each, _ in self._messages if each >= stamp)):
            return False
        eye = "" if self._info is None else self._info.header.frame_id.lstrip("/")
        connected = eye not in ("", frame.lstrip("/")) and self._frames.is_connected(frame, eye)
        return not connected or not self._frames.is_awaited(frame, eye, stamp)

    def _is_mask_awaited(self, stamp: int) -> bool:
        """Return whether the mask of the puppets of this stamp will soon come; none does of who has fallen silent."""
        if self._newest_mask is None:
            self._newest_mask = stamp
            return True
        return stamp not in self._masks and self._newest_mask <= stamp <= self._newest_mask + self._settings.wait * 1e9

    def drop_until(self, stamp: int) -> None:
        """Drop the puppets that no cloud after this stamp can need: all but the last before it."""
        before = sum(each <= stamp for each, _ in self._messages)
        self._messages = self._messages[max(before - 1, 0) :]
        first = self._messages[0][0] if self._messages else stamp
        self._masks = {each: message for each, message in self._masks.items() if each >= first}

    def find(self, header: Any, stamp: int, rotation: F64, translation: F64) -> PairedPuppets:
        """Return the puppets at the time of a cloud.

        Between two images the joints move evenly; beyond the last one they stay where they are.

        Args:
            header: of the cloud.
            stamp: of the cloud in nanoseconds.
            rotation: (3, 3), and `translation` (3,) m, from the frame in which the camera is returned to the cloud's.
            translation: see `rotation`.

        Raises:
            InputError: in one sentence, when there are no puppets or nothing says how camera and cloud belong together.
        """
        before = [pair for pair in self._messages if pair[0] <= stamp][-1:]
        after = [] if before and before[0][0] == stamp else [pair for pair in self._messages if pair[0] > stamp][:1]
        gaps = [abs(stamp - each) * 1e-9 for each, _ in (*before, *after)]
        if not gaps or min(gaps) > self._settings.max_lag:
            raise InputError(
                "no puppets came for the clouds yet"
                if not gaps
                else f"the puppets nearest to a cloud are {min(gaps):.2f} s from it, beyond the fusion.max_lag of "
                f"{self._settings.max_lag:g} s: it is used without them"
            )
        usable = [pair for pair, gap in zip((*before, *after), gaps, strict=True) if gap <= self._settings.max_lag]
        nearest = min(usable, key=lambda pair: (abs(stamp - pair[0]), pair[0]))[1]
        camera = self._make_camera(header, stamp, nearest, (rotation, translation))
        people = [self._add_masks(each, self._decode(message, camera), camera) for each, message in usable]
        if len(usable) == 1:
            return PairedPuppets(camera, people[0] if usable[0][0] == stamp else _drop_masks(people[0]))
        share = (stamp - usable[0][0]) / (usable[1][0] - usable[0][0])
        return PairedPuppets(camera, carry_puppets(people[0], people[1], share))

    def _make_camera(self, header: Any, stamp: int, puppets: Any, to_cloud: tuple[F64, F64]) -> Camera:
        info = None if self._info is None else describe_images(self._info)
        if info is None:
            raise InputError(
                "no puppets/camera_info came yet: puppets cannot be used with a cloud without the colour camera's "
                "calibration; publish or remap it"
            )
        frame, cloud = info.header.frame_id.lstrip("/"), header.frame_id.lstrip("/")
        seen_in = puppets.header.frame_id.lstrip("/")
        if frame and seen_in and frame != seen_in:
            raise InputError(
                f"the puppets are of the camera {seen_in!r}, puppets/camera_info is of {frame!r}: remap the one that "
                "belongs to them"
            )
        frame = frame or seen_in
        pose = (np.zeros(3), np.eye(3)) if frame == cloud else self._frames.lookup_pose(cloud, frame, stamp)
        if pose is None:
            raise InputError(
                f"{self._frames.describe_missing(cloud, frame, stamp)}: puppets cannot be used with the cloud"
            )
        rotation, translation = pose[1] @ to_cloud[0], pose[1] @ to_cloud[1] + pose[0]
        if self._settings.rectified:
            matrix = np.asarray(info.p, float).reshape(3, 4)[:, :3].ravel()
            return Camera.from_info(matrix, [], info.width, info.height, rotation, translation)
        return Camera.from_info(info.k, info.d, info.width, info.height, rotation, translation, info.distortion_model)

    def _add_masks(self, stamp: int, puppets: list[PuppetJoints], camera: Camera) -> list[PuppetJoints]:
        """Return the puppets of an image with their masks, if there is a label image of its stamp."""
        try:
            return add_masks(puppets, self._masks[stamp], camera.size) if stamp in self._masks else puppets
        except InputError as error:
            self._report.warn(str(error))
            self._report.counters["unusable masks"] += 1
            return puppets

    def _decode(self, message: Any, camera: Camera) -> list[PuppetJoints]:
        found = []
        width, height = camera.size
        for puppet in message.puppets:
            pixels, confidence = decode_puppet_joints(puppet)
            sure = pixels[confidence >= MIN_OUTSIDE_CONFIDENCE] / (width, height)
            if _is_outside(sure):
                raise InputError(
                    f"puppets lie outside of the {width}x{height} image of puppets/camera_info: it is that of another "
                    "camera or image size"
                )
            identity = puppet.id if puppet.id[:1].isalpha() or not puppet.id else f"p{puppet.id}"
            names = [joint.name for joint in puppet.joints]
            made = place_joints(self._model, identity, names, pixels, confidence, _find_hidden(puppet))
            if made is not None:
                found.append(made)
        return found


def _drop_masks(puppets: Sequence[PuppetJoints]) -> list[PuppetJoints]:
    """Return puppets without the masks of another time: nothing tells how they have moved."""
    return [replace(puppet, mask=None) for puppet in puppets]


def _is_outside(share: F64) -> bool:
    """Return whether a joint (of (K, 2) in shares of the image's size) lies clearly outside of the image."""
    return bool(((share > 1 + MAX_OUTSIDE) | (share < -MAX_OUTSIDE)).any())


def _find_hidden(puppet: Any) -> list[str]:
    """Return the names of the joints of arms that lie within the torso's outline and behind it."""
    parts = {part.name: part for part in puppet.parts}
    if "torso" not in parts:
        return []
    torso = parts["torso"]
    outline = np.asarray(torso.contour, np.float32).reshape(-1, 2)
    hidden = []
    for joint in puppet.joints:
        side, _, kind = joint.name.partition("_")
        part = parts.get(f"{side}_{_ARMS.get(kind, '')}")
        place = float(joint.x), float(joint.y)
        if part is None or part.depth >= torso.depth or len(outline) < 3 or not np.isfinite(place).all():
            continue
        if cv2.pointPolygonTest(outline, place, False) > 0:
            hidden.append(joint.name)
    return hidden
