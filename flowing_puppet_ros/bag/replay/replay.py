# SPDX-License-Identifier: Apache-2.0
"""Run the stream components over a recording: every message, in log order, with the same results every time."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from flowing_puppet_ros import __version__
from flowing_puppet_ros.bag.depth_topics import read_samples
from flowing_puppet_ros.bag.foreign.static_frames import is_of_people
from flowing_puppet_ros.bag.reader import Record, RecordingLike, open_bag
from flowing_puppet_ros.bag.replay.build import build_graph
from flowing_puppet_ros.bag.replay.graph import Graph, Instance
from flowing_puppet_ros.bag.replay.preview import STATIC_TRANSFORMS, RecordingPreview
from flowing_puppet_ros.bag.replay.run import Call, GraphRun, Step
from flowing_puppet_ros.bag.replay.unused import count_used, explain_unused
from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.process.threads import MAX_THREADS, one_blas_thread, one_opencv_thread, usable_threads
from flowing_puppet_ros.stream.component import COMPRESSED
from flowing_puppet_ros.stream.components.registry import COMPONENTS
from flowing_puppet_ros.stream.messages.detections import name_body
from flowing_puppet_ros.stream.messages.images import SharedImages
from flowing_puppet_ros.stream.messages.message_types import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    PUPPETS,
    TRANSFORMS,
)
from flowing_puppet_ros.stream.pairing.stuck_stamps import StuckStamps
from flowing_puppet_ros.stream.pipeline import Pipeline

METADATA_NAME = "flowing_puppet_ros"
"""Name of the output bag's metadata whose "replay" is JSON of the version, settings and counters of the replay."""
MAX_STEPS_PER_TOPIC = 4
"""Messages of the recording that are worked on or wait for it at a time, per topic: the bound of a replay's memory."""
_COPIED_TYPES = (CAMERA_INFO, PUPPETS, TRANSFORMS)
"""Types of input topics that are copied to the output bag, so that a viewer needs no other bag."""


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """Options of a replay.

    Attributes:
        rate: 1 is the speed of the recording, 0 as fast as possible.
        topic_map: old topic -> new topic.
        settings: component (puppet_tracker, visual_hull, body_fitter) -> setting -> value.
        seed: of every component that takes one.
        start_offset: seconds of recording to skip from the first usable message on.
        playback_duration: seconds to replay after `start_offset`.
        salvage: read what is whole of a truncated or damaged bag.
        progress: show a progress bar on stderr.
        jobs: threads, None for one per core; the results do not depend on it.
    """

    rate: float = 0.0
    topic_map: Mapping[str, str] = field(default_factory=dict)
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    seed: int = 0
    start_offset: float = 0.0
    playback_duration: float = math.inf
    salvage: bool = False
    progress: bool = True
    jobs: int | None = field(default=None, repr=False)

    def count_threads(self) -> int:
        """Return the number of threads that work."""
        return usable_threads(MAX_THREADS) if self.jobs is None else self.jobs


def replay(source: Path, target: Path, options: ReplayOptions | None = None) -> dict[str, Any]:
    """Replay the bag `source` into the bag `target` and return a summary that JSON can hold.

    `target` is one file if its name ends in .mcap, otherwise a folder. InputError if the source cannot be read or has
    no usable topic. What a component cannot use is counted, and each reason is one of the summary's `warnings`. If no
    message at all was used, `unused` has the reason of each topic.
    """
    options = options or ReplayOptions()
    if source.exists() and source.resolve() in (target.resolve(), target.parent.resolve()):
        raise InputError(f"{target} is the input itself or in its folder: name another output")
    begin = time.perf_counter()
    with one_blas_thread(), one_opencv_thread(), open_bag(source, options.salvage) as bag:
        run = _Replay(bag, options)
        with BagWriter(target) as writer:
            run.write_to(writer)
            writer.add_metadata(METADATA_NAME, {"replay": json.dumps(run.describe())})
            counts = writer.counts
    return run.summarise(source, target, time.perf_counter() - begin, counts)


@dataclass(frozen=True, slots=True)
class ReplayPlan:
    """What a replay of a recording would run, and what it would warn of before the first message."""

    graph: Graph
    warnings: tuple[str, ...]


def plan_replay(recording: RecordingLike) -> ReplayPlan:
    """Return what `replay` would run; InputError as of `replay`."""
    run = _Replay(recording, ReplayOptions())
    return ReplayPlan(run._graph, tuple(run.warnings))


class _Replay:
    """One pass over a bag."""

    def __init__(self, bag: RecordingLike, options: ReplayOptions) -> None:
        self._bag = bag
        self._options = options
        self._factory = BagMessageFactory()
        preview = RecordingPreview(bag, options.topic_map, self._factory)
        self._new_name, self._static = preview.new_name, preview.static
        self.warnings: list[str] = [*bag.notes, *preview.warnings]
        self._stuck = StuckStamps()
        self._writing_seconds = 0.0
        samples = {self._new_name[name]: sample for name, sample in read_samples(bag).items()}
        self._graph = build_graph(
            preview.topics,
            samples,
            preview.build_frame_tree(),
            preview.infos,
            self._collect_settings(),
            self._factory,
            preview.read_cloud_frames(),
            preview.connect_frames(),
        )
        self.warnings += self._graph.notes
        self._recorded = {self._new_name[name]: detail for name, detail in bag.details.items()}
        self._routes = self._graph.find_routes(
            {name: detail.type for name, detail in self._recorded.items() if detail.count}
        )
        self._outputs = self._graph.find_outputs()
        # What others say on /tf is read and copied, between what the fitters publish there.
        self._replaced = {topic for topic, port in self._outputs.items() if port.type != TRANSFORMS}
        cameras = [name for name in self._recorded if len(self._find_pictures(name)) > 1]
        self._shared = SharedImages(MAX_STEPS_PER_TOPIC * len(cameras))
        copied = {self._new_name[name] for name, kind in bag.topics.items() if kind in _COPIED_TYPES}
        self._copied = (copied | {self._new_name[record.topic] for record in self._static}) - self._replaced
        for instance in self._graph.instances:
            for port in instance.component.outputs:
                if port.lazy:
                    instance.component.set_subscribed(port.name, True)

    def _collect_settings(self) -> dict[str, dict[str, Any]]:
        unknown = sorted(set(self._options.settings) - set(COMPONENTS))
        if unknown:
            raise InputError(f"there is no component {unknown[0]!r}; there are {', '.join(COMPONENTS)}")
        chosen = {name: dict(self._options.settings.get(name, {})) for name in COMPONENTS}
        for name, seed in (("puppet_tracker", "tracker.seed"), ("body_fitter", "fitter.seed")):
            chosen[name] = {seed: self._options.seed} | chosen[name]
        return chosen

    def write_to(self, writer: BagWriter) -> None:
        """Pass every message through the graph and write the results."""
        self._add_topics(writer)
        used = [name for name in self._bag.topics if self._is_needed(self._new_name[name])]
        total = sum(self._bag.details[name].count for name in used)
        bar = tqdm(total=total, desc="replay", unit="msg", file=sys.stderr, disable=not self._options.progress)
        log_time = self._static[0].log_time if self._static else 0
        with bar, Pipeline(self._options.count_threads(), MAX_STEPS_PER_TOPIC * max(1, len(used))) as pipeline:
            run = GraphRun(self._graph, self._routes, pipeline, writer, self._factory)
            for record in self._static:
                run.add(self._make_step(record, log_time))
            for record in pace(self._select_time_span(self._bag.messages(used)), self._options.rate):
                log_time = record.log_time
                run.add(self._make_step(record, log_time))
                bar.update()
            run.flush(log_time)
        self.warnings += run.warnings
        self._writing_seconds = run.writing_seconds

    def _select_time_span(self, records: Iterator[Record]) -> Iterator[Record]:
        """Yield the records of the selected time span; InputError if there are none."""
        first, last, selected = None, 0, False
        begin, length = self._options.start_offset * 1e9, self._options.playback_duration * 1e9
        for record in records:
            first, last = record.log_time if first is None else first, record.log_time
            if record.log_time - first > begin + length:
                break
            if record.log_time - first >= begin:
                selected = True
                yield record
        if first is not None and not selected:
            raise InputError(
                f"nothing is left of {self._bag.path} from second {self._options.start_offset:g} on: "
                f"it lasts {(last - first) * 1e-9:.1f} s"
            )

    def _is_needed(self, topic: str) -> bool:
        return (
            topic != STATIC_TRANSFORMS
            and topic not in self._replaced
            and (topic in self._routes or topic in self._copied)
        )

    def _add_topics(self, writer: BagWriter) -> None:
        """Add the output's topics in an order that does not depend on which message comes first."""
        for name, detail in self._bag.details.items():
            if self._new_name[name] in self._copied:
                qos = "latched" if self._new_name[name] == STATIC_TRANSFORMS else detail.qos
                writer.add_topic(self._new_name[name], detail.type, qos)
        if self._static and not writer.has_topic(STATIC_TRANSFORMS):  # found on other topics
            writer.add_topic(STATIC_TRANSFORMS, TRANSFORMS, "latched")
        for topic, port in self._outputs.items():
            if not port.recorded or port.per_person:
                continue
            if port.transport:
                writer.add_topic(f"{topic}/{port.transport}", COMPRESSED_IMAGE, port.qos)
            else:
                writer.add_topic(topic, port.type, port.qos)

    def _make_step(self, record: Record, log_time: int) -> Step:
        """Return what is to be done with a record."""
        topic = self._new_name[record.topic]
        step = Step(log_time)
        if topic in self._copied:
            step.copied = topic, record.raw
        routes = self._routes.get(topic, [])
        if not routes:
            return step
        try:
            message = record.message
        except InputError as error:
            step.warnings.append(str(error))
            return step
        if topic in self._outputs and is_of_people(message):
            return Step(log_time)
        if any(self._needs_time(instance, port) for instance, port in routes):
            step.warnings += self._stuck.advance(topic, record.log_time, message)
        pictures = self._find_pictures(topic)
        shared = self._shared.share(message, len(pictures)) if len(pictures) > 1 else message
        for instance, port in routes:
            given = shared if (instance, port) in pictures else name_body(instance.resolve(port), topic, message)
            step.calls.append(Call(instance, port, given))
        return step

    def _find_pictures(self, topic: str) -> list[tuple[Instance, str]]:
        """Return the inputs that a topic feeds with pictures, and not depth."""
        return [
            (instance, name)
            for instance, name in self._routes.get(topic, [])
            if any(port.name == name and port.transport == COMPRESSED for port in instance.component.inputs)
        ]

    def _needs_time(self, instance: Instance, port: str) -> bool:
        """Return whether messages of an input must follow one another in time; not if partners have their stamps."""
        return port in ("points", "depth") and instance.resolve("initial") not in self._recorded

    def describe(self) -> dict[str, Any]:
        """Return what made the results and what was counted; the same input and options give the same."""
        instances = self._graph.instances
        return {
            "version": __version__,
            "seed": self._options.seed,
            "start_offset": self._options.start_offset,
            "playback_duration": None if math.isinf(length := self._options.playback_duration) else length,
            "topic_map": dict(self._options.topic_map),
            "settings": {instance.name: instance.component.settings.values() for instance in instances},
            "counters": {instance.name: dict(sorted(instance.component.counters.items())) for instance in instances},
            "rejected": {each.name: told for each in instances if (told := each.component.describe_rejected())},
            "warnings": self.warnings,
        }

    def summarise(self, source: Path, target: Path, seconds: float, counts: Mapping[str, int]) -> dict[str, Any]:
        """Return the summary of the replay, ready for JSON."""
        instances = self._graph.instances
        spent_seconds = {instance.name: instance.seconds for instance in instances} | {"writing": self._writing_seconds}
        frames = sum(instance.component.counters["images"] for instance in instances)
        return {
            "input": str(source),
            "output": str(target),
            "frames": frames,
            "bodies": sum(instance.component.counters["bodies"] for instance in instances),
            "seconds": round(seconds, 2),
            "frames_per_second": round(frames / seconds, 2),
            "seconds_of": {name: round(spent, 2) for name, spent in spent_seconds.items()},
            "messages": dict(counts),
            **({} if count_used(instances) else {"unused": explain_unused(self._graph, self._recorded, self.warnings)}),
            **self.describe(),
        }


def pace(records: Iterator[Record], rate: float) -> Iterator[Record]:
    """Yield the records when they are due: at `rate` times the speed of the recording, at once if it is 0."""
    start: tuple[float, int] | None = None
    for record in records:
        if rate > 0:
            start = start or (time.monotonic(), record.log_time)
            due = start[0] + (record.log_time - start[1]) * 1e-9 / rate
            time.sleep(max(0.0, due - time.monotonic()))
        yield record
