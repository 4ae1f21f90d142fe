# SPDX-License-Identifier: Apache-2.0
"""Writes the videos of several calibrated cameras, and the people that somebody found in them, into one bag."""

from __future__ import annotations

import heapq
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from flowing_puppet_ros.bag.cameras.sources import CameraSource
from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.video_reader import VideoFrame
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.stream.messages import geometry, images, message_types

START_NS = 1_700_000_000 * geometry.NANOSECONDS
"""Stamp of the first frame: videos do not say when they were taken."""
WORLD = "world"
_DETECTOR_DELAY_NS = 8_000_000  # a detector's answer comes after the image


@dataclass(frozen=True, slots=True, eq=False)
class _Entry:
    """A frame of one camera, or the people in it."""

    source: CameraSource
    frame: VideoFrame
    people: Sequence[Keypoints] | None


def write_camera_bag(
    out: Path,
    sources: Sequence[CameraSource],
    cameras: Mapping[str, Camera],
    offsets: Mapping[str, float],
    progress: bool = True,
) -> dict[str, int]:
    """Write the bag `out` and return the number of messages per topic.

    Images are compressed, each with its camera_info; people go to `detections`; the cameras' poses to /tf_static.
    `cameras` and `offsets` (seconds to add to the stamps) are by the sources' names. InputError when a frame has
    another size than its camera.
    """
    with BagWriter(out) as writer:
        bag = _CameraBag(writer, cameras)
        bag.add_topics(sources)
        bag.write_poses()
        streams = [_read(order, source, offsets.get(source.name, 0.0)) for order, source in enumerate(sources)]
        total = sum(len(source.frames.files) or source.frames.count for source in sources)
        with tqdm(total=total, desc="import", unit="frame", file=sys.stderr, disable=not progress) as bar:
            # Merged by time, then images before people, then in the order of the cameras.
            for log_time, is_people, _, entry in heapq.merge(*streams, key=lambda event: event[:3]):
                if is_people:
                    bag.write_people(log_time, entry)
                else:
                    bag.write_image(log_time, entry)
                    bar.update()
        return writer.counts


def _read(order: int, source: CameraSource, offset: float) -> Iterator[tuple[int, int, int, _Entry]]:
    """Yield (log time, 0 for an image or 1 for people, order, entry) of one camera by time."""
    waiting: list[tuple[int, int, int, _Entry]] = []
    for frame in source.frames:
        stamp = (
            START_NS
            + round(offset * geometry.NANOSECONDS)
            + int(frame.index * geometry.NANOSECONDS / source.frames.fps)
        )
        people = None if source.people is None else source.people.get(frame.index)
        entry = _Entry(source, VideoFrame(frame.index, stamp, frame.image, frame.path), people)
        while waiting and waiting[0][0] <= stamp:
            yield waiting.pop(0)
        yield stamp, 0, order, entry
        if people is not None:
            waiting.append((stamp + _DETECTOR_DELAY_NS, 1, order, entry))
    yield from waiting


class _CameraBag:
    """The messages of several cameras."""

    def __init__(self, writer: BagWriter, cameras: Mapping[str, Camera]) -> None:
        self._writer = writer
        self._cameras = cameras
        self._factory = BagMessageFactory()

    def add_topics(self, sources: Sequence[CameraSource]) -> None:
        """Announce the topics."""
        self._writer.add_topic("/tf_static", message_types.TRANSFORMS, "latched")
        for source in sources:
            name = source.name
            self._writer.add_topic(f"/{name}/image/compressed", message_types.COMPRESSED_IMAGE, "sensor")
            self._writer.add_topic(f"/{name}/camera_info", message_types.CAMERA_INFO, "sensor")
            if source.people is not None:
                self._writer.add_topic(f"/{name}/detections", message_types.PUPPETS, "reliable")

    def _header(self, stamp: int, camera: str) -> Any:
        return geometry.make_header(self._factory, stamp, f"{camera}_optical_frame")

    def write_poses(self) -> None:
        """Write the poses of the cameras in the world."""
        world = geometry.make_header(self._factory, START_NS, WORLD)
        poses = [
            geometry.make_transform(self._factory, world, f"{name}_optical_frame", camera.centre, camera.rotation.T)
            for name, camera in self._cameras.items()
        ]
        self._writer.write("/tf_static", START_NS, self._factory.make(message_types.TRANSFORMS, transforms=poses))

    def write_image(self, log_time: int, entry: _Entry) -> None:
        """Write one frame and the camera_info that belongs to it."""
        name, rgb = entry.source.name, entry.frame.image
        camera, header = self._cameras[name], self._header(entry.frame.stamp_ns, name)
        if rgb.shape[1::-1] != camera.size:
            raise InputError(
                f"frame {entry.frame.index} of {name} is {rgb.shape[1]}x{rgb.shape[0]}, the ones before "
                f"{camera.size[0]}x{camera.size[1]}"
            )
        info = geometry.make_camera_info(self._factory, header, camera.size, camera.matrix, camera.distortion)
        data = images.encode_jpeg(rgb)
        image = self._factory.make(message_types.COMPRESSED_IMAGE, header=header, format="jpeg", data=data)
        self._writer.write(f"/{name}/camera_info", log_time, info)
        self._writer.write(f"/{name}/image/compressed", log_time, image)

    def write_people(self, log_time: int, entry: _Entry) -> None:
        """Write whom a detector found in a frame."""
        name = entry.source.name
        puppets = [self._make_puppet(person) for person in entry.people or ()]
        header = self._header(entry.frame.stamp_ns, name)
        array = self._factory.make(message_types.PUPPETS, header=header, puppets=puppets)
        self._writer.write(f"/{name}/detections", log_time, array)

    def _make_puppet(self, person: Keypoints) -> Any:
        joints = [
            self._factory.make("flowing_puppet_msgs/msg/PuppetJoint", name=name, x=x, y=y, confidence=c)
            for name, (x, y), c in zip(person.names, person.xy, person.confidence, strict=True)
        ]
        return self._factory.make(
            "flowing_puppet_msgs/msg/Puppet",
            id=person.track_id,
            confidence=float(np.nan_to_num(person.confidence).mean()),
            joints=joints,
        )
