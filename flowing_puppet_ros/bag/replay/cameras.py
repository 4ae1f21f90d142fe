# SPDX-License-Identifier: Apache-2.0
"""The cameras of a recording, found from its topics, and which of them are calibrated against each other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.stream.messages.geometry import FrameTree
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE

IMAGE_NAMES = ("image", "image_raw", "image_color", "image_rect", "image_rect_color")
"""Last names of the image topics of cameras, in order of preference."""
MIN_CAMERAS = 2
"""Minimum calibrated cameras for a visual hull and the fit to its silhouettes."""


@dataclass(frozen=True, slots=True)
class CameraTopics:
    """The topics of one camera in a recording."""

    namespace: str
    image: str

    @property
    def name(self) -> str:
        """The camera's name: its namespace without the leading slash."""
        return self.namespace.lstrip("/")


def find_cameras(topics: Mapping[str, str]) -> list[CameraTopics]:
    """Return the cameras whose images are among the topics (name -> type), by namespace."""
    found: dict[str, str] = {}
    for base in IMAGE_NAMES:
        for topic, kind in topics.items():
            image = topic.removesuffix("/compressed") if kind == COMPRESSED_IMAGE else topic
            namespace, _, name = image.rpartition("/")
            if kind in (IMAGE, COMPRESSED_IMAGE) and name == base:
                found.setdefault(namespace, image)
    return [CameraTopics(namespace, found[namespace]) for namespace in sorted(found)]


def select_calibrated(
    cameras: list[CameraTopics], frames: FrameTree, infos: Mapping[str, Any]
) -> tuple[list[CameraTopics], str]:
    """Return the largest group of calibrated cameras with a common root frame, and why others are not in it."""
    groups: dict[str, list[CameraTopics]] = {}
    reasons = []
    for camera in cameras:
        try:
            groups.setdefault(_find_root(camera, frames, infos), []).append(camera)
        except InputError as error:
            reasons.append(f"{camera.name}: {error}")
    chosen = max(groups.values(), key=len, default=[])
    for root, group in groups.items():
        if group is not chosen:
            reasons += [f"{camera.name}: its frames end in {root!r}" for camera in group]
    if not reasons:
        return chosen, ""
    what = "without these cameras" if len(chosen) >= MIN_CAMERAS else f"not built, it needs {MIN_CAMERAS} cameras"
    return chosen, f"the visual hull is {what} ({'; '.join(reasons)})"


def _find_root(camera: CameraTopics, frames: FrameTree, infos: Mapping[str, Any]) -> str:
    """Return the root of a camera's frame; InputError if the camera is not calibrated or its frame has no parent."""
    info = infos.get(f"{camera.namespace}/camera_info")
    if info is None:
        raise InputError(f"there is no {camera.namespace}/camera_info")
    frame = info.header.frame_id.lstrip("/")
    root = frames.find_root(frame)
    if root == frame:
        raise InputError(f"/tf_static has no transform to its frame {frame!r}")
    pose = frames.lookup_pose(root, frame)
    assert pose is not None
    translation, rotation = pose
    Camera.from_info(info.k, info.d, info.width, info.height, rotation, translation, info.distortion_model)
    return root


def find_info_topics(topics: Mapping[str, str]) -> list[str]:
    """Return the topics of type CameraInfo."""
    return [topic for topic, kind in topics.items() if kind == CAMERA_INFO]
