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
from flowing_puppet_ros.stream.component import base_topic, is_compressed_depth_topic
from flowing_puppet_ros.stream.messages.geometry import stamp_ns
from flowing_puppet_ros.stream.messages.images import decode_image
from flowing_puppet_ros.stream.messages.message_types import COMPRESSED_IMAGE, IMAGE, PUPPETS
from flowing_puppet_ros.stream.messages.puppets import decode_keypoints


@dataclass(frozen=True, slots=True)
class BagFrames:
    """Iterable of (frame, detections or None); `fps` is from the first and last stamp, `count` of all images."""

    path: Path
    topic: str
    detections: dict[int, list[Keypoints]]
    fps: float
    count: int
    salvage: bool
    warn: Callable[[str], None]

    def __iter__(self) -> Iterator[tuple[VideoFrame, list[Keypoints] | None]]:
        """Read the images in the order of the bag; None stands for a stamp on which no detector ran.

        An unreadable image is warned of and left out, but counts in the index.
        """
        with open_bag(self.path, self.salvage) as bag:
            for index, record in enumerate(bag.messages([self.topic])):
                try:
                    stamp = stamp_ns(record.message)
                    frame = VideoFrame(index, stamp, decode_image(record.message), "")
                except InputError as error:
                    self.warn(f"frame {index}: {error}")
                    continue
                yield frame, self.detections.get(stamp)


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
        people_topics = [name for name, kind in bag.topics.items() if kind == PUPPETS and name.endswith("/detections")]
        detected = {name.removesuffix("/detections"): name for name in people_topics}
        chosen = [topic] if topic else [name for name in images if _camera_namespace(name) in detected]
        chosen = chosen or _leave_out_depth(bag, images)
        if not chosen or chosen[0] not in images:
            listed = ", ".join(images) or "none"
            raise InputError(f"{path} has no images on {topic or 'any topic'}; its image topics are: {listed}")
        source = detected.get(_camera_namespace(chosen[0]), "")
        people = {}
        for message in _read_usable(bag, source, warn):
            people[stamp_ns(message)] = decode_keypoints(message)
        stamps = [stamp_ns(message) for message in _read_usable(bag, chosen[0], lambda sentence: None)]
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


def _read_usable(bag: Bag, topic: str, warn: Callable[[str], None]) -> Iterator[Any]:
    """Yield the valid messages of a topic ("" has none) and warn of the others."""
    for record in bag.messages([topic]) if topic else ():
        try:
            message = record.message
        except InputError as error:
            warn(str(error))
        else:
            yield message


def _camera_namespace(image: str) -> str:
    """Return the camera's namespace: /cam01 for /cam01/image_raw/compressed."""
    return base_topic(image).rpartition("/")[0]
