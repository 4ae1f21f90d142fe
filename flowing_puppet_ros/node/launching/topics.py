# SPDX-License-Identifier: Apache-2.0
"""The topic that an argument `auto` of a launch file means: the only one of its kind that is published."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from flowing_puppet_ros.errors import InputError

AUTO = "auto"
DISCOVERY_S, SETTLING_S = 8.0, 1.0  # until the first topic of a kind must be seen, and for others to follow


@dataclass(frozen=True, slots=True)
class TopicKind:
    """Topics that an argument may name.

    Attributes:
        argument: its name.
        types: message types.
        excluded: regular expression of names that are something else in spite of their type.
        preferred: regular expression of names that win when there are several.
    """

    argument: str
    types: tuple[str, ...]
    excluded: str
    preferred: str


COLOUR_IMAGE = TopicKind(
    "image",
    ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"),
    r"depth|disparity|infra|(^|[/_])ir([/_]|$)|confidence|mask|/theora|/zstd"
    r"|/(overlay|part_labels|silhouettes|flow)(/|$)",
    r"/image_(rect_color|rect|color|raw)$|/(color|rgb)/image",
)
CLOUD = TopicKind(
    "points", ("sensor_msgs/msg/PointCloud2",), r"/(hull|body_vertices|map|.*costmap.*)$", r"/(points|points_raw)$"
)


def choose_topic(topics: Mapping[str, Sequence[str]], kind: TopicKind) -> str:
    """Return the only topic of a kind among the published topics {name: types}, or the only preferred one.

    Raises:
        InputError: when there is none or no plain choice; the sentence lists the candidates.
    """
    found = find_candidates(topics, kind)
    best = [name for name in found if re.search(kind.preferred, name)]
    for choice in (found, best):
        if len(choice) == 1:
            return choice[0]
    if not found:
        types = " or ".join(name.rpartition("/")[2] for name in kind.types)
        raise InputError(f"nobody publishes a {types} for {kind.argument}; start the driver, or name the topic with"
                         f" {kind.argument}:=TOPIC")  # fmt: skip
    raise InputError(f"{kind.argument} could be {', '.join(found)}; choose with {kind.argument}:=TOPIC")


def find_candidates(topics: Mapping[str, Sequence[str]], kind: TopicKind) -> list[str]:
    """Return the topics of a kind by name; a compressed topic counts as the one that it transports."""
    names = {
        name.removesuffix("/compressed")
        for name, types in topics.items()
        if set(types) & set(kind.types) and not re.search(kind.excluded, name)
    }
    return sorted(names)


def find_topic(given: str, kind: TopicKind) -> str:
    """Return the topic that is `given`, or found on the running graph if that is `auto`.

    Raises:
        InputError: see choose_topic.
    """
    return given if given != AUTO else choose_topic(list_topics(kind), kind)


def list_topics(kind: TopicKind, wait: float = DISCOVERY_S) -> dict[str, list[str]]:
    """Return what is published now {name: types}, as soon as a topic of the kind is there, or after `wait` seconds."""
    import rclpy
    from rclpy.context import Context

    context = Context()
    rclpy.init(context=context)
    node = rclpy.create_node("flowing_puppet_launch", context=context, start_parameter_services=False)
    try:
        end = time.monotonic() + wait
        settled = None
        while True:
            topics = {name: types for name, types in node.get_topic_names_and_types() if node.count_publishers(name)}
            now = time.monotonic()
            if settled is None and find_candidates(topics, kind):
                settled = now + SETTLING_S
            if now >= min(end, settled or end):
                return topics
            time.sleep(0.1)
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)
