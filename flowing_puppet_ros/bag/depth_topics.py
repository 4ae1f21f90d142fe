# SPDX-License-Identifier: Apache-2.0
"""Select the depth images in a recording to which bodies can be fitted."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import suppress
from typing import Any

from flowing_puppet_ros.bag.reader import Bag
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.component import base_topic, is_compressed_depth_topic
from flowing_puppet_ros.stream.messages.compressed_depth import source_encoding
from flowing_puppet_ros.stream.messages.images import is_depth_encoding
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE

PREFERRED_NAMES = ("depth", "image_rect", "image_rect_raw", "image_raw")
"""Names of depth images in order of preference within a namespace: the driver's rectified one comes first."""


def read_encodings(bag: Bag) -> dict[str, str]:
    """Return topic -> encoding of its first readable message, for raw images and compressed depth."""
    found: dict[str, str] = {}
    for name, topic in bag.details.items():
        if not topic.count or not (
            topic.type == IMAGE or (topic.type == COMPRESSED_IMAGE and is_compressed_depth_topic(name))
        ):
            continue
        for record in bag.messages([name]):
            with suppress(InputError):
                found[name] = image_encoding(name, record.message)
                break
    return found


def image_encoding(topic: str, message: Any) -> str:
    """Return the encoding of an Image, or of the depth image in a CompressedImage; empty for other messages."""
    if not hasattr(message, "format"):
        return str(message.encoding)
    return source_encoding(message.format) if is_compressed_depth_topic(topic) else ""


def holds_depth(topic: str, encoding: str) -> bool:
    """Return whether images on a topic hold depth, heat or the like, not pictures; mono16 depends on the name."""
    return is_depth_encoding(encoding) and ("depth" in topic.lower() or encoding.lower() != "mono16")


def select_depth_topics(
    topics: Mapping[str, str], encoded: Mapping[str, str], clouds: Collection[str]
) -> tuple[list[str], list[str]]:
    """Return the topics of depth images to fit bodies to, and notes on those that are left out.

    `topics` is name -> type, `encoded` image topic -> encoding, and `clouds` are the cloud topics that bodies are
    fitted to already. The encoding alone does not distinguish depth from heat or confidence, so the name has to
    contain "depth". At most one topic per namespace is selected, which needs a camera_info beside it, and none if the
    camera's points were recorded too. The name is that of the raw image even if only `compressedDepth` was recorded.
    """
    chosen: dict[str, str] = {}
    notes = []
    for recorded in sorted(encoded, key=_preference):
        topic = base_topic(recorded)
        namespace = topic.rpartition("/")[0]
        info = f"{namespace}/camera_info"
        if not holds_depth(recorded, encoded[recorded]) or namespace in chosen:
            continue
        points = [cloud for cloud in clouds if _is_same_camera(namespace, cloud)]
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


def _preference(topic: str) -> tuple[int, str]:
    name = base_topic(topic).rpartition("/")[2]
    return PREFERRED_NAMES.index(name) if name in PREFERRED_NAMES else len(PREFERRED_NAMES), topic


def _is_same_camera(namespace: str, cloud: str) -> bool:
    """Return whether a cloud is published in or below the namespace of the depth images."""
    return cloud.rpartition("/")[0] == namespace or (bool(namespace) and cloud.startswith(f"{namespace}/"))
