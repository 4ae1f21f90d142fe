# SPDX-License-Identifier: Apache-2.0
"""Pass the messages of a recording through the graph on several threads, with the results of one thread.

Every message of the recording is a step. In it each component is a task after those whose outputs it takes, and the
writer one after all of them. Each call and each output carries its place: where a single thread would have come to it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from graphlib import TopologicalSorter
from typing import Any

from flowing_puppet_ros.bag.replay.graph import Graph, Instance
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.stream.component import Output
from flowing_puppet_ros.stream.messages.images import compress_image
from flowing_puppet_ros.stream.messages.message_types import TRANSFORMS, MessageFactory
from flowing_puppet_ros.stream.pipeline import Pipeline, Task

type Place = tuple[int, int, tuple[int, ...], int]
"""Number of the call of the step from which something follows, how many components away it is, the numbers of outputs
and receivers on the way, and the number of the receiver, -1 for the writer. A thread that passes on every output of a
call before it comes to what the receivers made of them does things in the order of their places."""
type Routes = Mapping[str, Sequence[tuple[Instance, str]]]
"""Topic -> the instances that it feeds, each with the input port."""


@dataclass(frozen=True, slots=True, eq=False)
class Call:
    """A message for an input port of an instance; without a port the instance is flushed."""

    instance: Instance
    port: str = ""
    message: Any = None


@dataclass(slots=True, eq=False)
class Step:
    """What one recorded message gives.

    Attributes:
        log_time: of everything that is written, ns.
        calls: what is called, in order.
        copied: topic and bytes of a message that is written as it is, before everything else.
        warnings: what was wrong with the message itself.
    """

    log_time: int
    calls: list[Call] = field(default_factory=list)
    copied: tuple[str, bytes] | None = None
    warnings: list[str] = field(default_factory=list)


@dataclass(slots=True, eq=False)
class _Progress:
    """What the components made of a step so far: calls that wait, by instance, and what will be written or said."""

    waiting: dict[Instance, list[tuple[Place, Call]]]
    made: list[tuple[Place, Instance, str, Any]] = field(default_factory=list)
    said: list[tuple[Place, str]] = field(default_factory=list)


class GraphRun:
    """The components of a graph at work in a pipeline, and the writer behind them.

    `warnings` has what components and messages gave reason to say, in the order of the steps; it is complete when the
    pipeline is done. So is `writing_seconds`, the time in which messages were compressed and written.
    """

    def __init__(
        self, graph: Graph, routes: Routes, pipeline: Pipeline, writer: BagWriter, factory: MessageFactory
    ) -> None:
        """Find which instance takes outputs of which."""
        self.warnings: list[str] = []
        self.writing_seconds = 0.0
        self._routes, self._pipeline, self._writer, self._factory = routes, pipeline, writer, factory
        self._sources: dict[Instance, set[Instance]] = {instance: set() for instance in graph.instances}
        for instance in graph.instances:
            ports = [
                replace(port, name=instance.resolve(port.name))
                for port in instance.component.outputs
                if port.type != TRANSFORMS
            ]
            for topic, receivers in routes.items():
                if any(port.covers(topic) for port in ports):
                    for receiver, _ in receivers:
                        self._sources[receiver].add(instance)
        self._order = list(TopologicalSorter(self._sources).static_order())

    def add(self, step: Step) -> None:
        """Start a step; it may be finished later."""
        involved: list[Instance] = []
        called = {call.instance for call in step.calls}
        for instance in self._order:
            if instance in called or not self._sources[instance].isdisjoint(involved):
                involved.append(instance)
        progress = _Progress({instance: [] for instance in involved})
        for number, call in enumerate(step.calls):
            progress.waiting[call.instance].append(((number, 0, (), 0), call))
        tasks = [
            Task(
                instance,
                self._make_work(instance, progress),
                tuple(place for place, other in enumerate(involved) if other in self._sources[instance]),
            )
            for instance in involved
        ]
        tasks.append(Task("writer", lambda: self._write_step(step, progress), tuple(range(len(involved)))))
        self._pipeline.add(tasks)

    def flush(self, log_time: int) -> None:
        """Let every instance release what waits, in the graph's order."""
        self.add(Step(log_time, [Call(instance) for instance in self._sources]))

    def _make_work(self, instance: Instance, progress: _Progress) -> Callable[[], None]:
        def work() -> None:
            for place, call in sorted(progress.waiting.pop(instance), key=lambda item: item[0]):
                outputs = _run_timed(call)
                said = instance.component.report.drain_warnings()
                progress.said += [(place, f"{instance.name}: {sentence}") for sentence in said]
                self._pass_on(instance, place, outputs, progress)

        return work

    def _pass_on(self, instance: Instance, place: Place, outputs: Output, progress: _Progress) -> None:
        root, distance, way, receiver_number = place
        for number, (name, message) in enumerate(outputs):
            if message is None:  # the end of a person's topic, which a bag cannot express
                continue
            here = (root, distance + 1, (*way, receiver_number, number))
            progress.made.append(((*here, -1), instance, name, message))
            if instance.component.find_output(name).type == TRANSFORMS:  # where people are moves no sensor
                continue
            for index, (receiver, port) in enumerate(self._routes.get(instance.resolve(name), ())):
                progress.waiting[receiver].append(((*here, index), Call(receiver, port, message)))

    def _write_step(self, step: Step, progress: _Progress) -> None:
        begin = time.perf_counter()
        if step.copied is not None:
            topic, raw = step.copied
            self._writer.write_raw(topic, step.log_time, raw)
        self.warnings += [sentence for sentence in step.warnings if sentence not in self.warnings]
        for _, instance, name, message in sorted(progress.made, key=lambda item: item[0]):
            self._write(step.log_time, instance, name, message)
        self.warnings += [sentence for _, sentence in sorted(progress.said, key=lambda item: item[0])]
        self.writing_seconds += time.perf_counter() - begin

    def _write(self, log_time: int, instance: Instance, name: str, message: Any) -> None:
        topic, port = instance.resolve(name), instance.component.find_output(name)
        if not port.recorded:
            return
        if port.per_person and not self._writer.has_topic(topic):
            self._writer.add_topic(topic, port.type, port.qos)
        if port.transport:
            self._writer.write(f"{topic}/{port.transport}", log_time, compress_image(self._factory, message))
        else:
            self._writer.write(topic, log_time, message)


def _run_timed(call: Call) -> Output:
    component, begin = call.instance.component, time.perf_counter()
    outputs = component.handle(call.port, call.message) if call.port else component.flush()
    call.instance.seconds += time.perf_counter() - begin
    return outputs
