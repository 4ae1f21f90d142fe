# SPDX-License-Identifier: Apache-2.0
"""Select the colour camera in a recording whose puppets the depth images or clouds of a sensor are joined with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from flowing_puppet_ros.bag.depth_topics import ImageSample, count_common, find_info
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.geometry import FrameTree


@dataclass(frozen=True, slots=True)
class ColourTopics:
    """The topics of a colour camera: its images, and the camera_info that belongs to them ("" without one)."""

    image: str
    info: str
    frame: str

    @property
    def rectified(self) -> bool:
        """Whether the images are rectified, by their name (REP-118 and image_proc)."""
        return "rect" in self.image.rpartition("/")[2]


def find_colour_topics(
    images: Sequence[str], samples: Mapping[str, ImageSample], infos: Mapping[str, Any]
) -> list[ColourTopics]:
    """Return the topics of the cameras of some image topics; without a camera_info they cannot be joined.

    `samples` is image topic -> first image, `infos` topic -> first CameraInfo.
    """
    found = []
    for image in images:
        sample = samples.get(image, ImageSample(""))
        beside = f"{image.rpartition('/')[0]}/camera_info"
        info = beside if beside in infos else find_info(image, sample.frame, sample.size, infos)
        frame = infos[info].header.frame_id.lstrip("/") if info else ""
        found.append(ColourTopics(image, info, frame or sample.frame))
    return found


def choose_colour(
    source: str, frame: str, cameras: Sequence[ColourTopics], frames: FrameTree
) -> tuple[ColourTopics | None, str]:
    """Return the camera whose puppets a sensor's data are joined with, if any, and what is to be said about it, or "".

    Args:
        source: topic of the depth images or clouds.
        frame: their frame; empty when it is not known.
        cameras: those of the recording.
        frames: the transforms. Data and camera have the same frame, or these connect them.
    """
    calibrated = [camera for camera in cameras if camera.info]
    if not calibrated:
        missing = ", ".join(camera.image for camera in cameras)
        return None, f"{source} is used without colour: there is no camera_info for {missing}" if cameras else ""
    connected = [camera for camera in calibrated if not frame or _is_connected(frame, camera.frame, frames)]
    if not connected:
        listed = ", ".join(f"{camera.image} (frame {camera.frame!r})" for camera in calibrated)
        return None, (
            f"{source} is used without colour: /tf and /tf_static do not connect its frame {frame!r} with that of "
            f"{listed}; record the transform"
        )
    best = max(
        connected, key=lambda camera: (camera.frame == frame, count_common(camera.image, source), -len(camera.image))
    )
    return best, ""


def _is_connected(frame: str, other: str, frames: FrameTree) -> bool:
    try:
        return frame == other or frames.is_connected(frame, other)
    except InputError:  # a loop
        return False
