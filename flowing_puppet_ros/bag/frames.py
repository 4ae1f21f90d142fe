# SPDX-License-Identifier: Apache-2.0
"""The images of one camera in a bag, each with the detections of its stamp."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowing_puppet_ros.bag.depth_topics import holds_depth, read_samples
from flowing_puppet_ros.bag.reader import Bag, open_bag
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.video_reader import VideoFrame
from flowing_puppet_ros.reporting import Report
from flowing_puppet_ros.stream.component import base_topic, is_compressed_depth_topic
from flowing_puppet_ros.stream.messages.detections import (
    OTHER_DETECTIONS,
    collect_detections,
    decode_detections,
    find_body_id,
    name_body,
)
from flowing_puppet_ros.stream.messages.geometry import stamp_ns
from flowing_puppet_ros.stream.messages.images import decode_image
from flowing_puppet_ros.stream.messages.message_types import COMPRESSED_IMAGE, IMAGE, PUPPETS


@dataclass(frozen=True, slots=True)
class BagFrames:
    """Iterable of (frame, detections or None); `fps` is from the first and last stamp, `count` of all images.

    `detections` are messages by stamp, whose people can depend on the size of the image.
    """

    path: Path
    topic: str
    detections: dict[int, Any]
    fps: float
    count: int
    salvage: bool
    warn: Callable[[str], None]

    def __iter__(self) -> Iterator[tuple[VideoFrame, list[Keypoints] | None]]:
        """Read the images in the order of the bag; None stands for a stamp on which no detector ran.

        An unreadable image is warned of and left out, but counts in the index.
        """
        report = Report()
        with open_bag(self.path, self.salvage) as bag:
            for index, record in enumerate(bag.messages([self.topic])):
                try:
                    stamp = stamp_ns(record.message)
                    frame = VideoFrame(index, stamp, decode_image(record.message), "")
                except InputError as error:
                    self.warn(f"frame {index}: {error}")
                    continue
                yield frame, self._decode(self.detections.get(stamp), frame, report)

    def _decode(self, message: Any, frame: VideoFrame, report: Report) -> list[Keypoints] | None:
        if message is None:
            return None
        people = None
        try:
            people = decode_detections(message, (frame.image.shape[1], frame.image.shape[0]), report)
        except InputError as error:
            report.warn(str(error))
        for sentence in report.drain_warnings():
            self.warn(f"frame {frame.index}: {sentence}")
        return people


def open_bag_frames(
    path: Path, topic: str = "", salvage: bool = False, warn: Callable[[str], None] = lambda sentence: None
) -> BagFrames:
    """Open the images on `topic`, or on the first image topic whose namespace has detections, or on the first at all.

    `salvage` reads what is whole of a truncated file; `warn` is called for every unusable message. InputError if there
    is no such topic (it lists the image topics) or the topic has no messages.
    """
    with open_bag(path, salvage) as bag:
        for note in bag.notes:
            warn(note)
        kinds = (IMAGE, COMPRESSED_IMAGE)
        images = sorted(
            name for name, kind in bag.topics.items() if kind in kinds and not is_compressed_depth_topic(name)
        )
        people_topics = [
            name
            for name, kind in bag.topics.items()
            if name.endswith("/detections") and kind in (PUPPETS, *OTHER_DETECTIONS)
        ]
        detected = {name.removesuffix("/detections"): name for name in people_topics}
        chosen = [topic] if topic else [name for name in images if _camera_namespace(name) in detected]
        chosen = chosen or _leave_out_depth(bag, images)
        if not chosen or chosen[0] not in images:
            listed = ", ".join(images) or "none"
            raise InputError(f"{path} has no images on {topic or 'any topic'}; its image topics are: {listed}")
        source = detected.get(_camera_namespace(chosen[0]), "")
        people: dict[int, Any] = {}
        bodies = [name for name in bag.topics if find_body_id(source, name)]
        for topic, message in _read_usable(bag, [source, *bodies] if source else [], warn):
            stamp = stamp_ns(message)
            people[stamp] = collect_detections(people.get(stamp), name_body(source, topic, message))
        stamps = [stamp_ns(message) for _, message in _read_usable(bag, [chosen[0]], lambda sentence: None)]
    if not stamps:
        raise InputError(f"{path} has no message on {chosen[0]}")
    span = (max(stamps) - min(stamps)) * 1e-9
    fps = (len(stamps) - 1) / span if span > 0 else 0.0
    return BagFrames(path, chosen[0], people, fps, bag.details[chosen[0]].count, salvage, warn)


def _leave_out_depth(bag: Bag, images: list[str]) -> list[str]:
    """Return the image topics that have messages and hold no depth, or all if there are none."""
    samples = read_samples(bag)
    depth = {name for name, sample in samples.items() if holds_depth(name, sample.encoding)}
    return [name for name in images if bag.details[name].count and name not in depth] or images


def _read_usable(bag: Bag, topics: list[str], warn: Callable[[str], None]) -> Iterator[tuple[str, Any]]:
    """Yield the valid messages of some topics, each with its topic, and warn of the others."""
    for record in bag.messages(topics):
        try:
            message = record.message
        except InputError as error:
            warn(str(error))
        else:
            yield record.topic, message


def _camera_namespace(image: str) -> str:
    """Return the camera's namespace: /cam01 for /cam01/image_raw/compressed."""
    return base_topic(image).rpartition("/")[0]
