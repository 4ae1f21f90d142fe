# SPDX-License-Identifier: Apache-2.0
"""The components that run on a recording, and how their topics connect."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from flowing_puppet_ros.stream.component import Component, Port
from flowing_puppet_ros.stream.messages.detections import find_body_id
from flowing_puppet_ros.stream.messages.message_types import COMPRESSED_IMAGE, IDS_LIST, SKELETON_2D


@dataclass(slots=True, eq=False)
class Instance:
    """A component in the graph: the namespace of its relative topics, and port -> topic for remapped ports.

    An input that is remapped to "" gets nothing.
    """

    name: str
    component: Component[Any]
    namespace: str
    remapped: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0

    def resolve(self, port: str) -> str:
        """Return the absolute topic of a port."""
        if port in self.remapped:
            return self.remapped[port]
        return port if port.startswith("/") else f"{self.namespace}/{port}"


@dataclass(slots=True, eq=False)
class Graph:
    """The components for a recording, in the order in which messages reach them; `notes` say what is missing."""

    instances: list[Instance]
    notes: list[str] = field(default_factory=list)

    def find_routes(self, recorded: Mapping[str, str]) -> dict[str, list[tuple[Instance, str]]]:
        """Return topic -> (instance, input port) it feeds; `recorded` is topic -> type of the recording.

        An image's compressed topic feeds the same input, unless the raw image was recorded too, and so do the skeletons
        of the bodies in a list. A recorded topic of another type than the input's feeds nothing.
        """
        found: dict[str, list[tuple[Instance, str]]] = {}
        for instance in self.instances:
            for port in instance.component.inputs:
                topic = instance.resolve(port.name)
                if not topic:
                    continue
                kind = recorded.get(topic, port.type)
                if port.accepts(kind) or (port.transport and kind == COMPRESSED_IMAGE):
                    found.setdefault(topic, []).append((instance, port.name))
                if port.accepts(kind) and kind == IDS_LIST:
                    for skeleton in find_skeletons(topic, recorded):
                        found.setdefault(skeleton, []).append((instance, port.name))
                if port.transport and topic not in recorded:
                    found.setdefault(f"{topic}/{port.transport}", []).append((instance, port.name))
        return found

    def find_outputs(self) -> dict[str, Port]:
        """Return topic -> the output port that publishes it."""
        return {instance.resolve(port.name): port for instance in self.instances for port in instance.component.outputs}


def find_skeletons(listing: str, topics: Mapping[str, str]) -> list[str]:
    """Return the topics of the skeletons of the bodies that are listed on the topic `listing`."""
    return sorted(name for name, kind in topics.items() if kind == SKELETON_2D and find_body_id(listing, name))
