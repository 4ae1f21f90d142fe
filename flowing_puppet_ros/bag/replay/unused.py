# SPDX-License-Identifier: Apache-2.0
"""Whether a replay used anything of a recording, and why it did not."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from flowing_puppet_ros.bag.reader import Topic
from flowing_puppet_ros.bag.replay.cameras import IMAGE_NAMES
from flowing_puppet_ros.bag.replay.graph import Graph, Instance
from flowing_puppet_ros.stream.component import base_topic
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, PUPPETS, TRANSFORMS

_SENSOR_PORTS = ("points", "depth", "silhouettes")
_HELPERS = (CAMERA_INFO, PUPPETS, TRANSFORMS)
"""Types that say something about images and clouds, and give no result without them."""


def count_used(instances: Iterable[Instance]) -> int:
    """Return the number of images and clouds that a component could use, whether it found people in them or not."""
    used = 0
    for instance in instances:
        counters = instance.component.counters
        used += counters["images"]
        ports = [port.name for port in instance.component.inputs if port.name.rpartition("/")[2] in _SENSOR_PORTS]
        received = sum(counters[f"received {port}"] for port in ports)
        used += max(0, received - counters["unusable"]) if received else 0
    return used


def explain_unused(graph: Graph, recorded: Mapping[str, Topic], warnings: Iterable[str]) -> dict[str, str]:
    """Return topic -> why nothing came of it, for the topics of a recording of which nothing was used.

    `warnings` are those of the replay: those of a component begin with its name, others have the topic's name in them.
    """
    said = list(warnings)
    routes = graph.find_routes({name: topic.type for name, topic in recorded.items()})
    return {name: _explain(name, topic, routes.get(name, []), said) for name, topic in sorted(recorded.items())}


def _explain(name: str, topic: Topic, routes: Sequence[tuple[Instance, str]], warnings: list[str]) -> str:
    if not topic.count:
        return "no messages"
    if topic.type in _HELPERS:
        return f"{topic.type} alone gives no result"
    for instance, _ in routes:
        own = [text.removeprefix(f"{instance.name}: ") for text in warnings if text.startswith(f"{instance.name}: ")]
        if own:
            return own[0]
    # The name of the topic, and not the beginning of another.
    about = [text for text in warnings if base_topic(name) in text.replace(",", " ").replace(":", " ").split()]
    if about:
        return about[0]
    if routes:
        return f"{topic.type} alone gives no result"
    if topic.type in (IMAGE, COMPRESSED_IMAGE):
        namespace = base_topic(name).rpartition("/")[0]
        return f"images are wanted on {', '.join(IMAGE_NAMES)}; --topic-map {name}:={namespace}/image renames them"
    return f"the type {topic.type} is not read"
