# SPDX-License-Identifier: Apache-2.0
"""Inspect the topics of a running ROS graph, from what was heard of them for a while."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from flowing_puppet_ros.bag.reader import Record, Topic
from flowing_puppet_ros.bag.replay.graph import Graph, Instance
from flowing_puppet_ros.doctor.finding import Inspection
from flowing_puppet_ros.doctor.recording import SENSOR_TYPES, inspect_recording

BEST_EFFORT, VOLATILE = "best_effort", "volatile"


@dataclass(frozen=True, slots=True)
class Publisher:
    """The node that publishes a topic, and the reliability and durability that it offers."""

    node: str
    type: str
    reliability: str
    durability: str


@dataclass(slots=True)
class LiveRecording:
    """What was heard of a graph: as a bag, with the publishers of each topic."""

    seconds: float
    details: dict[str, Topic]
    publishers: dict[str, list[Publisher]]
    records: list[Record]
    path: Path = Path("live")
    notes: list[str] = field(default_factory=list)

    @property
    def topics(self) -> dict[str, str]:
        """The types of the topics by name."""
        return {name: topic.type for name, topic in self.details.items()}

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Record]:
        """Yield the messages of `topics` (all by default) in the order in which they arrived."""
        return (record for record in self.records if topics is None or record.topic in topics)


def inspect_live(recording: LiveRecording) -> Inspection:
    """Return what the nodes can do with the topics, what is missing or does not connect, and how to start them."""
    found = Inspection("live", "running ROS graph")
    for name, publishers in sorted(recording.publishers.items()):
        types = {publisher.type for publisher in publishers}
        if len(types) > 1:
            found.add("warning", f"{name} is published with several types: {', '.join(sorted(types))}")
    for name, topic in sorted(recording.details.items()):
        if not topic.count and topic.type in SENSOR_TYPES:
            found.add("warning", f"{name} has a publisher but was silent for {recording.seconds:g} s")
    graph = inspect_recording(recording, found, _NodeAdvice(recording))
    _tell_qos(graph, recording, found)
    return found


def _tell_qos(graph: Graph, recording: LiveRecording, found: Inspection) -> None:
    """Add the topics whose publishers offer less than the nodes ask for, so that they do not connect."""
    for instance in graph.instances:
        kind = instance.name.rpartition("/")[2]
        for port in instance.component.inputs:
            topic = instance.resolve(port.name)
            for publisher in recording.publishers.get(topic, []):
                for policy, offered, asked in (
                    ("reliability", publisher.reliability == BEST_EFFORT, port.qos != "sensor"),
                    ("durability", publisher.durability == VOLATILE, port.qos == "latched"),
                ):
                    if offered and asked:
                        value = publisher.reliability if policy == "reliability" else publisher.durability
                        found.add(
                            "error",
                            f"{topic}: {publisher.node} offers {policy} {value}, {kind} asks for more, so they do not"
                            " connect",
                            f"{kind} --ros-args -p qos_overrides.{topic}.subscription.{policy}:={value}",
                        )


@dataclass(frozen=True, slots=True)
class _NodeAdvice:
    """A node for each component, its topics remapped."""

    recording: LiveRecording

    def start(self, instance: Instance) -> str:
        """Return the command that starts the node of a component on the topics that there are."""
        words = [
            f"-r {port.name}:={topic}"
            for port in instance.component.inputs
            if (topic := instance.resolve(port.name)) not in (port.name, f"/{port.name}")
            and {topic, f"{topic}/{port.transport}"} & set(self.recording.details)
        ]
        kind = instance.name.rpartition("/")[2]
        if kind == "visual_hull":
            words.insert(0, f"-p cameras:={instance.component.settings.values()['cameras']}")
        if rig := instance.component.settings.values().get("rig.cameras"):
            words.insert(0, f"-p rig.cameras:={rig}")
        return " ".join([kind, *(["--ros-args", *words] if words else [])])

    def rename(self, old: str, new: str) -> str:
        """Return the command that starts a node on a topic of another name."""
        name = new.rpartition("/")[2]
        node = "body_fitter" if name in ("depth", "camera_info") else "puppet_tracker"
        return f"{node} --ros-args -r {name}:={old}"
