# SPDX-License-Identifier: Apache-2.0
"""Inspect the topics of a recording, or of what was heard live: what they are used for, what is missing or wrong."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, Protocol

from flowing_puppet_ros.bag.reader import RecordingLike
from flowing_puppet_ros.bag.replay.graph import Graph, Instance
from flowing_puppet_ros.bag.replay.replay import plan_replay
from flowing_puppet_ros.bag.replay.unused import explain_unused
from flowing_puppet_ros.doctor.finding import Inspection
from flowing_puppet_ros.doctor.topic_samples import TopicSample, compare_clocks, describe_faults, sample_topics
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.networks.files import FILES, find_file
from flowing_puppet_ros.image.networks.sources import NOT_INSTALLED
from flowing_puppet_ros.stream.component import base_topic
from flowing_puppet_ros.stream.messages.message_types import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    POINT_CLOUD,
    TRANSFORMS,
)

_RENAME = re.compile(r"--topic-map (/\S+?:=/[^\s;,]+)")
SENSOR_TYPES = (IMAGE, COMPRESSED_IMAGE, POINT_CLOUD)


class Advice(Protocol):
    """The commands to run next."""

    def start(self, instance: Instance) -> str:
        """Return the command that runs a component on its topics."""
        ...

    def rename(self, old: str, new: str) -> str:
        """Return the command that uses topic `old` as if it were called `new`."""
        ...


def inspect_recording(recording: RecordingLike, found: Inspection, advice: Advice) -> Graph:
    """Add what can be computed from a recording, and what is missing, to the findings; return what would run.

    InputError if it cannot be read.
    """
    for note in recording.notes:
        found.add("warning", note)
    topics = {name: topic.type for name, topic in recording.details.items()}
    try:
        plan = plan_replay(recording)
        graph, notes = plan.graph, [note for note in plan.warnings if note not in recording.notes]
    except InputError as error:
        graph, notes = Graph([]), str(error).split("; ")[1:]
        found.add("error", str(error), _add_rename(advice, str(error)))
    routes = graph.find_routes({name: topic.type for name, topic in recording.details.items() if topic.count})
    samples = sample_topics(recording, {**dict.fromkeys(routes), **_list_helpers(topics)})
    faults = {
        name: describe_faults(name, sample, _find_info(name, routes, samples)) for name, sample in samples.items()
    }
    for instance in graph.instances:
        _tell_instance(instance, routes, samples, faults, found, advice)
    for note in notes:
        if graph.instances:
            found.add("warning", note, _add_rename(advice, note))
    for name in samples:
        for fault in faults[name]:
            found.add("error" if fault.prevents else "warning", f"{name}: {fault.sentence}", fault.command)
    _tell_unused(recording, graph, routes, [*notes, *recording.notes], found, advice)
    found.topics += list(_list_topics(recording, routes, samples))
    return graph


def _list_helpers(topics: Mapping[str, str]) -> dict[str, None]:
    return dict.fromkeys(name for name, kind in topics.items() if kind in (CAMERA_INFO, TRANSFORMS))


def _find_info(
    topic: str, routes: Mapping[str, list[tuple[Instance, str]]], samples: Mapping[str, TopicSample]
) -> TopicSample | None:
    """Return the sample of the camera_info of depth images on a topic, None for other topics."""
    for instance, port in routes.get(topic, []):
        if port == "depth":
            return samples.get(instance.resolve("camera_info"))
    return None


def _tell_instance(
    instance: Instance,
    routes: Mapping[str, list[tuple[Instance, str]]],
    samples: Mapping[str, TopicSample],
    faults: Mapping[str, list[Any]],
    found: Inspection,
    advice: Advice,
) -> None:
    """Add what one component computes, or why it computes nothing; and whether its topics have one clock."""
    feeding = {port: name for name, fed in routes.items() for other, port in fed if other is instance}
    recorded = {port: name for port, name in feeding.items() if name in samples and samples[name].count}
    sentence = _describe(instance, recorded, samples)
    broken = [name for name in recorded.values() if any(fault.prevents for fault in faults.get(name, ()))]
    if not recorded and "silhouettes" not in feeding:
        found.add("error", f"{sentence}, but there are no messages")
    elif broken:
        found.add("warning", f"{sentence}, but not with {' and '.join(broken)} as it is")
    else:
        found.add("ready", sentence, advice.start(instance))
    leading = next((recorded[port] for port in ("image", "points", "depth") if port in recorded), "")
    partners = [recorded[port] for port in ("detections", "camera_info", "initial") if port in recorded]
    for partner in partners if leading else []:
        apart = compare_clocks(leading, samples[leading], partner, samples[partner])
        if apart:
            found.add("warning", apart)


def _describe(instance: Instance, recorded: Mapping[str, str], samples: Mapping[str, TopicSample]) -> str:
    """Return what a component computes from its topics."""

    def rated(port: str) -> str:
        name = recorded.get(port, instance.resolve(port))
        return f"{name}{samples[name].describe_rate() if name in samples else ''}"

    kind = instance.name.rpartition("/")[2]
    if kind == "puppet_tracker":
        if "detections" in recorded:
            people = f"the detections on {recorded['detections']}"
        elif all(find_file(network) for network in FILES):
            people = "people found by the keypoint networks"
        else:
            people = f"people found by this package's own detector ({NOT_INSTALLED})"
        return f"puppets in the images on {rated('image')}, from {people}"
    if kind == "visual_hull":
        cameras = [
            port.name.removesuffix("/image") for port in instance.component.inputs if port.name.endswith("/image")
        ]
        return f"silhouettes, visual hull and triangulated joints from the cameras {', '.join(cameras)}"
    if isinstance(rig := instance.component.settings.values().get("rig.cameras"), str) and rig:
        seen = sorted(name for port, name in recorded.items() if port.endswith(("/depth", "/points")))
        seen = [" and ".join(seen) or rig]
        seen += [f"the silhouettes on {silhouettes}"] if (silhouettes := instance.resolve("silhouettes")) else []
        return f"one body a person from {' with '.join(seen)} together, joined by /tf"
    if "points" in recorded:
        return f"bodies in the clouds on {rated('points')}"
    if "depth" in recorded:
        return f"bodies in the depth images on {rated('depth')} with {instance.resolve('camera_info')}"
    source = next((port for port in ("silhouettes", "points", "depth") if instance.resolve(port)), "points")
    return f"bodies from {instance.resolve(source)}"


def _tell_unused(
    recording: RecordingLike,
    graph: Graph,
    routes: Mapping[str, Any],
    notes: list[str],
    found: Inspection,
    advice: Advice,
) -> None:
    """Add why images and clouds are not used, and which topics are of no use here."""
    made = graph.find_outputs()
    reasons = explain_unused(graph, recording.details, notes)
    said = " ".join(finding.sentence for finding in found.findings)
    others = []
    for name, topic in sorted(recording.details.items()):
        if name in routes or name in made or topic.type in (CAMERA_INFO, TRANSFORMS):
            continue
        if topic.type not in SENSOR_TYPES:
            others.append(f"{name} ({topic.type})")
        elif base_topic(name) not in re.split(r"[\s,;:]+", said) or not graph.instances:
            found.add("note", f"{name} is not used: {reasons[name]}", _add_rename(advice, reasons[name]))
    if others:
        found.add("note", f"of no use here: {', '.join(others)}")


def _add_rename(advice: Advice, sentence: str) -> str:
    """Return the command with the --topic-map that a sentence names, "" if it names none."""
    rename = _RENAME.search(sentence)
    return advice.rename(*rename[1].split(":=")) if rename else ""


def _list_topics(
    recording: RecordingLike, routes: Mapping[str, list[tuple[Instance, str]]], samples: Mapping[str, TopicSample]
) -> Iterator[dict[str, Any]]:
    for name, topic in sorted(recording.details.items()):
        sample = samples.get(name)
        yield {
            "name": name,
            "type": topic.type,
            "messages": topic.count,
            "rate_hz": None if sample is None or sample.rate is None else round(sample.rate, 2),
            "used_as": sorted({f"{instance.name}: {port}" for instance, port in routes.get(name, [])}),
        }
