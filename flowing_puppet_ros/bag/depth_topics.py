# SPDX-License-Identifier: Apache-2.0
"""Which image topics of a recording are depth images that bodies can be fitted to."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import suppress
from typing import Any

from flowing_puppet_ros.bag.reader import Bag
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.component import base_topic, sends_depth
from flowing_puppet_ros.stream.messages.compressed_depth import sent_encoding
from flowing_puppet_ros.stream.messages.images import is_depth
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE

RECTIFIED_FIRST = ("depth", "image_rect", "image_rect_raw", "image_raw")
"""Which of the depth images of one namespace is taken: the driver's own rectified one comes first."""


def encodings(bag: Bag) -> dict[str, str]:
    """Return the encoding of the first readable message of every topic of raw images, or of compressed depth."""
    found: dict[str, str] = {}
    for name, topic in bag.details.items():
        if not topic.count or not (topic.type == IMAGE or (topic.type == COMPRESSED_IMAGE and sends_depth(name))):
            continue
        for record in bag.messages([name]):
            with suppress(InputError):
                found[name] = encoding_of(name, record.message)
                break
    return found


def encoding_of(topic: str, message: Any) -> str:
    """Return the encoding of an Image, or of the depth image that a CompressedImage was; empty of other ones."""
    if not hasattr(message, "format"):
        return str(message.encoding)
    return sent_encoding(message.format) if sends_depth(topic) else ""


def holds_depth(topic: str, encoding: str) -> bool:
    """Whether images on a topic hold depth, or heat, or something else that is no picture; mono16 may be one."""
    return is_depth(encoding) and ("depth" in topic.lower() or encoding.lower() != "mono16")


def depth_topics(
    topics: Mapping[str, str], encoded: Mapping[str, str], clouds: Collection[str]
) -> tuple[list[str], list[str]]:
    """Return the depth images that bodies are fitted to, and sentences about those that are left out.

    `topics` are names and types, `encoded` image topics and their encodings, `clouds` the cloud topics that bodies are
    fitted to already. The encoding alone does not tell depth from heat or confidence, so the name has to say "depth".
    One topic a namespace, with the camera_info beside it; none where the camera's points were recorded too. Of what was
    recorded by the transport `compressedDepth` alone, the name is that of the image itself.
    """
    chosen: dict[str, str] = {}
    notes = []
    for recorded in sorted(encoded, key=_rectified_first):
        topic = base_topic(recorded)
        namespace = topic.rpartition("/")[0]
        info = f"{namespace}/camera_info"
        if not holds_depth(recorded, encoded[recorded]) or namespace in chosen:
            continue
        points = [cloud for cloud in clouds if _of_one_camera(namespace, cloud)]
        if "depth" not in topic.lower():
            if topics.get(info) == CAMERA_INFO:
                notes.append(
                    f"{topic} holds {encoded[recorded]} images and may be depth: --topic-map "
                    f"{topic}:={namespace}/depth fits bodies to it"
                )
        elif topics.get(info) != CAMERA_INFO:
            notes.append(
                f"no body is fitted to the depth images on {topic}: there is no {info}; --topic-map renames one"
            )
        elif points:
            notes.append(f"bodies are fitted to the points on {points[0]}, not to the depth images on {topic} too")
        else:
            chosen[namespace] = topic
    return sorted(chosen.values()), notes


def _rectified_first(topic: str) -> tuple[int, str]:
    name = base_topic(topic).rpartition("/")[2]
    return RECTIFIED_FIRST.index(name) if name in RECTIFIED_FIRST else len(RECTIFIED_FIRST), topic


def _of_one_camera(namespace: str, cloud: str) -> bool:
    """Whether a cloud is published beside the depth images of a namespace, or below it."""
    return cloud.rpartition("/")[0] == namespace or (bool(namespace) and cloud.startswith(f"{namespace}/"))
