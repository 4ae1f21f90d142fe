# SPDX-License-Identifier: Apache-2.0
"""Run the stream components over a recording: every message, in log order, the same answer every time."""

from __future__ import annotations

import json
import math
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from flowing_puppet_ros import __version__
from flowing_puppet_ros.bag.depth_topics import encodings
from flowing_puppet_ros.bag.graph import Instance, build_graph, info_topics
from flowing_puppet_ros.bag.reader import Bag, Record, open_bag
from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.component import Output, Port
from flowing_puppet_ros.stream.messages.geometry import FrameTree
from flowing_puppet_ros.stream.messages.images import compress
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO, COMPRESSED_IMAGE, PUPPETS, TRANSFORMS

STATIC = "/tf_static"
NOTE = "flowing_puppet_ros"
"""Name of the output bag's metadata whose "replay" is JSON of the version, settings and counters of the replay."""
_CARRIED = (CAMERA_INFO, PUPPETS, TRANSFORMS)
"""Types of input topics that go into the output bag too, so that a viewer needs no other bag for frames and cameras."""
_COMPONENTS = ("optical_flow", "puppet_tracker", "visual_hull", "body_fitter")
_TOO_LARGE = ("flow/forward", "flow/backward")


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """What a replay is told.

    rate: 0 is as fast as it goes, 1 the speed of the recording. topic_map: old name -> new name. settings: component
    (puppet_tracker, visual_hull, body_fitter) -> setting -> value. seed: of every component that takes one.
    start_offset: seconds that are left out, by the times of recording, from the first message that could be used on;
    playback_duration: seconds from there on.
    """

    rate: float = 0.0
    topic_map: Mapping[str, str] = field(default_factory=dict)
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    seed: int = 0
    start_offset: float = 0.0
    playback_duration: float = math.inf
    salvage: bool = False
    progress: bool = True


def replay(source: Path, target: Path, options: ReplayOptions | None = None) -> dict[str, Any]:
    """Replay the bag `source` into the bag `target` and return a summary that JSON can hold.

    `target` is one file when its name ends in .mcap, else a folder. InputError when the source cannot be read or has no
    usable topic. What a component cannot use is counted and said once in the summary's `warnings`.
    """
    options = options or ReplayOptions()
    if source.exists() and source.resolve() in (target.resolve(), target.parent.resolve()):
        raise InputError(f"{target} is the input itself or in its folder: name another output")
    begin = time.perf_counter()
    with open_bag(source, options.salvage) as bag:
        run = _Replay(bag, options)
        with BagWriter(target) as writer:
            run.write_to(writer)
            writer.note(NOTE, {"replay": json.dumps(run.record())})
            counts = writer.counts
    return run.summary(source, target, time.perf_counter() - begin, counts)


class _Replay:
    """One pass over a bag."""

    def __init__(self, bag: Bag, options: ReplayOptions) -> None:
        self._bag = bag
        self._options = options
        self._new_name = {name: options.topic_map.get(name, name) for name in bag.topics}
        self._factory = BagMessageFactory()
        self.warnings: list[str] = list(bag.notes)
        topics = {self._new_name[name]: kind for name, kind in bag.topics.items()}
        unknown = sorted(set(options.topic_map) - set(bag.topics))
        if unknown:
            raise InputError(f"--topic-map names {unknown[0]}, but the topics are {', '.join(sorted(bag.topics))}")
        if len(topics) < len(bag.topics):
            new = next(name for name in topics if list(self._new_name.values()).count(name) > 1)
            raise InputError(f"--topic-map gives two topics the name {new}: choose another name")
        self._static = self._static_records(topics)
        infos = self._first_infos(topics)
        encoded = {self._new_name[name]: encoding for name, encoding in encodings(bag).items()}
        self._graph = build_graph(topics, encoded, self._frames(), infos, self._settings(), self._factory)
        self.warnings += self._graph.notes
        held = {self._new_name[name]: detail.type for name, detail in bag.details.items() if detail.count}
        self._routes = self._graph.routes(held)
        self._outputs = self._graph.outputs()
        carried = {self._new_name[name] for name, kind in bag.topics.items() if kind in _CARRIED}
        self._carried = carried - set(self._outputs)
        for instance in self._graph.instances:
            for port in instance.component.outputs:
                if port.lazy:
                    instance.component.set_subscribed(port.name, True)

    def _settings(self) -> dict[str, dict[str, Any]]:
        unknown = sorted(set(self._options.settings) - set(_COMPONENTS))
        if unknown:
            raise InputError(f"there is no component {unknown[0]!r}; there are {', '.join(_COMPONENTS)}")
        chosen = {name: dict(self._options.settings.get(name, {})) for name in _COMPONENTS}
        for name in ("puppet_tracker", "body_fitter"):
            chosen[name].setdefault("seed", self._options.seed)
        return chosen

    def _old_names(self, kinds: Mapping[str, str], wanted: Callable[[str], bool]) -> list[str]:
        return [old for old, new in self._new_name.items() if new in kinds and wanted(new)]

    def _static_records(self, topics: Mapping[str, str]) -> list[Record]:
        """All static transforms of the bag: a recording that was split or cut may hold them late."""
        names = self._old_names(topics, lambda name: name == STATIC and topics[name] == TRANSFORMS)
        return list(self._bag.messages(names)) if names else []

    def _frames(self) -> FrameTree:
        """The frames of the static transforms; those that cannot be used are warned of when they are replayed."""
        frames = FrameTree()
        for record in self._static:
            with suppress(InputError):
                frames.add(record.message)
        return frames

    def _first_infos(self, topics: Mapping[str, str]) -> dict[str, Any]:
        """Return the first message of every camera_info topic that can be read."""
        names = self._old_names(topics, set(info_topics(topics)).__contains__)
        found: dict[str, Any] = {}
        for record in self._bag.messages(names) if names else ():
            if record.topic not in found:
                with suppress(InputError):
                    found[record.topic] = record.message
            if len(found) == len(names):
                break
        return {self._new_name[old]: info for old, info in found.items()}

    def write_to(self, writer: BagWriter) -> None:
        """Drive every message through the graph and write what it makes."""
        self._announce(writer)
        used = [name for name in self._bag.topics if self._needed(self._new_name[name])]
        total = sum(self._bag.details[name].count for name in used)
        bar = tqdm(total=total, desc="replay", unit="msg", file=sys.stderr, disable=not self._options.progress)
        log_time = self._static[0].log_time if self._static else 0
        for record in self._static:
            self._take(writer, record, log_time)
        with bar:
            for record in paced(self._asked_for(self._bag.messages(used)), self._options.rate):
                log_time = record.log_time
                self._take(writer, record, log_time)
                bar.update()
            for instance in self._graph.instances:
                self._emit(writer, log_time, instance, self._timed(instance, instance.component.flush))

    def _asked_for(self, records: Iterator[Record]) -> Iterator[Record]:
        """The records of the time that was asked for; InputError when there is none."""
        first, last, found = None, 0, False
        begin, length = self._options.start_offset * 1e9, self._options.playback_duration * 1e9
        for record in records:
            first, last = record.log_time if first is None else first, record.log_time
            if record.log_time - first > begin + length:
                break
            if record.log_time - first >= begin:
                found = True
                yield record
        if first is not None and not found:
            raise InputError(
                f"nothing is left of {self._bag.path} from second {self._options.start_offset:g} on: "
                f"it lasts {(last - first) * 1e-9:.1f} s"
            )

    def _needed(self, topic: str) -> bool:
        return topic != STATIC and topic not in self._outputs and (topic in self._routes or topic in self._carried)

    def _announce(self, writer: BagWriter) -> None:
        """Name the output's topics in an order that does not depend on what comes first."""
        for name, detail in self._bag.details.items():
            if self._new_name[name] in self._carried:
                qos = "latched" if self._new_name[name] == STATIC else detail.qos
                writer.add_topic(self._new_name[name], detail.type, qos)
        for topic, port in self._outputs.items():
            if port.name in _TOO_LARGE or port.per_person:
                continue
            if port.transport:
                writer.add_topic(f"{topic}/{port.transport}", COMPRESSED_IMAGE, port.qos)
            else:
                writer.add_topic(topic, port.type, port.qos)

    def _take(self, writer: BagWriter, record: Record, log_time: int) -> None:
        topic = self._new_name[record.topic]
        if topic in self._carried:
            writer.write_raw(topic, log_time, record.raw)
        routes = self._routes.get(topic, [])
        if not routes:
            return
        try:
            message = record.message
        except InputError as error:
            if str(error) not in self.warnings:
                self.warnings.append(str(error))
            return
        for instance, port in routes:
            self._emit(writer, log_time, instance, self._handle(instance, port, message))

    def _handle(self, instance: Instance, port: str, message: Any) -> Output:
        return self._timed(instance, lambda: instance.component.handle(port, message))

    def _timed(self, instance: Instance, work: Callable[[], Output]) -> Output:
        begin = time.perf_counter()
        outputs = work()
        instance.seconds += time.perf_counter() - begin
        self.warnings += [f"{instance.name}: {sentence}" for sentence in instance.component.drain_warnings()]
        return outputs

    def _emit(self, writer: BagWriter, log_time: int, instance: Instance, outputs: Output) -> None:
        """Write messages and hand them on, in the order in which they were made."""
        queue = deque((instance, port, message) for port, message in outputs)
        while queue:
            source, name, message = queue.popleft()
            if message is None:  # the end of a person's topic, which a bag does not tell
                continue
            topic = source.topic(name)
            self._write(writer, topic, log_time, message, source.component.output(name))
            for receiver, port in self._routes.get(topic, []):
                queue.extend((receiver, made, item) for made, item in self._handle(receiver, port, message))

    def _write(self, writer: BagWriter, topic: str, log_time: int, message: Any, port: Port) -> None:
        if port.per_person and not writer.has_topic(topic):
            writer.add_topic(topic, port.type, port.qos)
        if port.transport:
            writer.write(f"{topic}/{port.transport}", log_time, compress(self._factory, message))
        elif port.name not in _TOO_LARGE:
            writer.write(topic, log_time, message)

    def record(self) -> dict[str, Any]:
        """Return what made the results and what was counted, which the same input and options make the same."""
        instances = self._graph.instances
        return {
            "version": __version__,
            "seed": self._options.seed,
            "start_offset": self._options.start_offset,
            "playback_duration": None if math.isinf(length := self._options.playback_duration) else length,
            "topic_map": dict(self._options.topic_map),
            "settings": {instance.name: _values(instance) for instance in instances},
            "counters": {instance.name: dict(sorted(instance.component.counters.items())) for instance in instances},
            "warnings": self.warnings,
        }

    def summary(self, source: Path, target: Path, seconds: float, counts: Mapping[str, int]) -> dict[str, Any]:
        """Return what happened, for people and for JSON."""
        instances = self._graph.instances
        frames = sum(instance.component.counters["images"] for instance in instances)
        return {
            "input": str(source),
            "output": str(target),
            "frames": frames,
            "bodies": sum(instance.component.counters["bodies"] for instance in instances),
            "seconds": round(seconds, 2),
            "frames_per_second": round(frames / seconds, 2),
            "seconds_of": {instance.name: round(instance.seconds, 2) for instance in instances},
            "messages": dict(counts),
            **self.record(),
        }


def _values(instance: Instance) -> dict[str, Any]:
    settings = instance.component.settings
    return {info.name: getattr(settings, info.name) for info in type(settings).describe()}


def paced(records: Iterator[Record], rate: float) -> Iterator[Record]:
    """Yield the records when they are due: at `rate` times the speed of the recording, at once when it is 0."""
    start: tuple[float, int] | None = None
    for record in records:
        if rate > 0:
            start = start or (time.monotonic(), record.log_time)
            due = start[0] + (record.log_time - start[1]) * 1e-9 / rate
            time.sleep(max(0.0, due - time.monotonic()))
        yield record
