# SPDX-License-Identifier: Apache-2.0
"""Select the depth images in a recording to which bodies can be fitted."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowing_puppet_ros.bag.reader import RecordingLike
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.stream.component import base_topic, is_compressed_depth_topic
from flowing_puppet_ros.stream.messages.camera_info import describe_images
from flowing_puppet_ros.stream.messages.compressed_depth import decode_compressed_depth, source_encoding
from flowing_puppet_ros.stream.messages.geometry import FrameTree
from flowing_puppet_ros.stream.messages.images import is_depth_encoding
from flowing_puppet_ros.stream.messages.message_types import COMPRESSED_IMAGE, IMAGE

PREFERRED_NAMES = ("depth", "image_rect", "image_rect_raw", "image_raw")
"""Names of depth images in order of preference within a namespace: the driver's rectified one comes first."""
RIG_DEPTHS_M, RIG_GRID, MIN_COMMON_SHARE = (1.0, 2.0, 3.0, 4.0, 5.0), 5, 0.1
"""Depths and pixels of the places by which it is told whether two cameras see the same, and the share of those that one
of them sees and the other could."""
MIN_BASELINE_M = 0.5
"""Between a depth camera and a colour camera from which on this sees another side of people."""


@dataclass(frozen=True, slots=True)
class ImageSample:
    """Encoding, frame and (width, height) of the first readable image on a topic; (0, 0) if it is not decoded."""

    encoding: str
    frame: str = ""
    size: tuple[int, int] = (0, 0)

    @property
    def description(self) -> str:
        """Size and frame for a sentence."""
        return f"{self.size[0]}x{self.size[1]}, frame {self.frame!r}"


@dataclass(frozen=True, slots=True)
class DepthTopic:
    """The topic of depth images and that of the camera_info that belongs to them."""

    image: str
    info: str

    @property
    def name(self) -> str:
        """The camera's name among several: the namespace of its images without the leading slash."""
        return base_topic(self.image).rpartition("/")[0].lstrip("/") or "camera"


def read_samples(bag: RecordingLike) -> dict[str, ImageSample]:
    """Return topic -> its first readable image, for raw images and for compressed ones that hold depth."""
    found: dict[str, ImageSample] = {}
    for name, topic in bag.details.items():
        if not topic.count or topic.type not in (IMAGE, COMPRESSED_IMAGE):
            continue
        for record in bag.messages([name]):
            with suppress(InputError):
                if sample := _read_sample(name, record.message):
                    found[name] = sample
                break
    return found


def _read_sample(topic: str, message: Any) -> ImageSample | None:
    encoding, frame = image_encoding(topic, message), message.header.frame_id.lstrip("/")
    if hasattr(message, "format") and not holds_depth(topic, encoding):
        return None
    try:
        return ImageSample(encoding, frame, read_size(message))
    except InputError:  # a later message may be whole
        return ImageSample(encoding, frame)


def read_size(message: Any) -> tuple[int, int]:
    """Return width and height of an Image or of a compressed depth image; InputError if that cannot be decoded."""
    if not hasattr(message, "format"):
        return int(message.width), int(message.height)
    height, width = decode_compressed_depth(message).shape
    return width, height


def image_encoding(topic: str, message: Any) -> str:
    """Return the encoding of an Image, or of the depth image in a CompressedImage; empty for other messages."""
    if not hasattr(message, "format"):
        return str(message.encoding)
    encoding = source_encoding(message.format)
    as_picture = "depth" in topic.lower() and is_depth_encoding(encoding)
    return encoding if is_compressed_depth_topic(topic) or as_picture else ""


def holds_depth(topic: str, encoding: str) -> bool:
    """Return whether images on a topic hold depth, heat or the like, not pictures; mono16 depends on the name."""
    return is_depth_encoding(encoding) and ("depth" in topic.lower() or encoding.lower() != "mono16")


def select_depth_topics(
    samples: Mapping[str, ImageSample], infos: Mapping[str, Any], clouds: Collection[str]
) -> tuple[list[DepthTopic], list[str]]:
    """Return the topics of depth images to fit bodies to, and notes on those that are left out.

    `samples` is image topic -> first image, `infos` topic -> first CameraInfo, and `clouds` are the cloud topics that
    bodies are fitted to already. The encoding alone does not distinguish depth from heat or confidence, so the name has
    to contain "depth". At most one topic per namespace is selected, and none if the camera's points were recorded too.
    The name is that of the raw image even if only `compressedDepth` was recorded.
    """
    chosen: dict[str, DepthTopic] = {}
    notes = []
    for recorded in sorted(samples, key=_preference):
        sample = samples[recorded]
        topic = base_topic(recorded)
        namespace = topic.rpartition("/")[0]
        if not holds_depth(recorded, sample.encoding) or namespace in chosen:
            continue
        points = [cloud for cloud in clouds if _is_same_camera(namespace, cloud)]
        if "depth" not in topic.lower():
            if f"{namespace}/camera_info" in infos:
                notes.append(
                    f"{topic} holds {sample.encoding} images and may be depth: --topic-map "
                    f"{topic}:={namespace}/depth fits bodies to it"
                )
        elif points:
            notes.append(f"bodies are fitted to the points on {points[0]}, not to the depth images on {topic} too")
        else:
            info, note = _choose_info(topic, sample, infos)
            notes += [note] if note else []
            if info:
                # An image that was compressed as a picture keeps the name of its own topic.
                whole = recorded if recorded.endswith("/compressed") else topic
                chosen[namespace] = DepthTopic(whole, info)
    return sorted(chosen.values(), key=lambda depth: depth.image), notes


def find_info(topic: str, frame: str, size: tuple[int, int], infos: Mapping[str, Any]) -> str:
    """Return the topic of the camera_info (of `infos`) of images: beside them, or of the same frame and size; or "".

    Depth that is registered to colour has the frame of the colour camera, whose namespace often has the only
    camera_info. Of several, the one whose name has most in common with the images' is taken. The one beside the images
    is taken too if no other fits better, whatever its size.
    """
    beside = f"{topic.rpartition('/')[0]}/camera_info"
    if beside in infos and _info_size(infos[beside], size) in (size, (0, 0)):
        return beside
    fitting = [
        name
        for name, info in infos.items()
        if _info_size(info, size) == size and info.header.frame_id.lstrip("/") == frame.lstrip("/") != ""
    ]
    return max(fitting, key=lambda name: (count_common(name, topic), name), default=beside if beside in infos else "")


def _choose_info(topic: str, sample: ImageSample, infos: Mapping[str, Any]) -> tuple[str, str]:
    """Return the camera_info topic of depth images, or "", and what is to be said about it, or ""."""
    beside = f"{topic.rpartition('/')[0]}/camera_info"
    found = find_info(topic, sample.frame, sample.size, infos)
    if found == beside:
        return found, ""
    if found:
        return found, f"the camera_info of the depth images on {topic} is taken from {found} ({sample.description})"
    note = f"no body is fitted to the depth images on {topic} ({sample.description}): there is no {beside}"
    if not infos:
        return "", f"{note}, nor any other camera_info; record it with the images"
    listed = ", ".join(
        f"{name} ({info.width}x{info.height}, frame {info.header.frame_id!r})" for name, info in sorted(infos.items())
    )
    first = min(infos, key=lambda name: (-count_common(name, topic), name))
    return (
        "",
        f"{note}, and no camera_info of that size and frame but {listed}; --topic-map {first}:={beside} takes one",
    )


def _info_size(info: Any, size: tuple[int, int]) -> tuple[int, int]:
    """Return width and height of the images of a CameraInfo, which are `size` if it does not say."""
    described = describe_images(info, size)
    return int(described.width), int(described.height)


def find_rig(depths: Sequence[DepthTopic], infos: Mapping[str, Any], frames: FrameTree) -> list[DepthTopic]:
    """Return the depth cameras that look at the same people: their static frames are connected, and their views meet.

    Empty without two of them.
    """
    usable = [depth for depth in depths if depth.info in infos]
    found = [
        depth
        for depth in usable
        if any(_see_the_same(infos[depth.info], infos[other.info], frames) for other in usable if other is not depth)
    ]
    return found if len(found) > 1 else []


def find_rig_of_cameras(
    depths: Sequence[DepthTopic], cameras: Sequence[Any], infos: Mapping[str, Any], frames: FrameTree
) -> list[DepthTopic]:
    """Return the depth cameras that look at the people whom colour `cameras` (CameraInfo) around them show.

    Of those that stand beside a depth camera it has no need: they would show the same side.
    """
    return [
        depth
        for depth in depths
        if depth.info in infos
        and any(
            _see_the_same(infos[depth.info], camera, frames) and _stand_apart(infos[depth.info], camera, frames)
            for camera in cameras
        )
    ]


def _stand_apart(first: Any, second: Any, frames: FrameTree) -> bool:
    """Return whether two cameras, by their CameraInfo, are no pair side by side in one housing."""
    pose = frames.lookup_pose(*(info.header.frame_id.lstrip("/") for info in (first, second)))
    return pose is not None and float(np.linalg.norm(pose[0])) >= MIN_BASELINE_M


def _see_the_same(first: Any, second: Any, frames: FrameTree) -> bool:
    """Return whether two cameras, by their CameraInfo, stand apart and much of what one could see the other could."""
    own, others = (info.header.frame_id.lstrip("/") for info in (first, second))
    pose = None
    with suppress(InputError):
        pose = None if own == others else frames.lookup_pose(own, others)
    if pose is None:
        return False
    try:
        own_camera, camera = (
            Camera.from_info(info.k, [], info.width, info.height, np.eye(3), np.zeros(3)) for info in (first, second)
        )
    except InputError:
        return False
    columns, rows = (np.linspace(0, side - 1, RIG_GRID) for side in own_camera.size)
    rays = own_camera.undistort(np.stack(np.meshgrid(columns, rows), axis=-1))
    ahead = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1).reshape(-1, 3)
    places = np.concatenate([depth * ahead for depth in RIG_DEPTHS_M]) @ pose[1].T + pose[0]
    pixels, depth = camera.project(places)
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= 0) & (pixels < camera.size)).all(axis=1) & (depth > 0) & (depth < RIG_DEPTHS_M[-1])
    return bool(inside.mean() >= MIN_COMMON_SHARE)


def count_common(first: str, second: str) -> int:
    """Return how many words two topics have in common from the start."""
    count = 0
    for left, right in zip(first.split("/"), second.split("/"), strict=False):
        if left != right:
            break
        count += 1
    return count


def _preference(topic: str) -> tuple[int, str]:
    name = base_topic(topic).rpartition("/")[2]
    return PREFERRED_NAMES.index(name) if name in PREFERRED_NAMES else len(PREFERRED_NAMES), topic


def _is_same_camera(namespace: str, cloud: str) -> bool:
    """Return whether a cloud is published in or below the namespace of the depth images."""
    return cloud.rpartition("/")[0] == namespace or (bool(namespace) and cloud.startswith(f"{namespace}/"))
