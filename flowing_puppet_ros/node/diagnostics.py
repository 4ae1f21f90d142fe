# SPDX-License-Identifier: Apache-2.0
"""The status of a node on /diagnostics (REP-107): state, rates, latency, drops, counters, the last error."""

from __future__ import annotations

import statistics
import threading
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

MAX_SILENCE_S = 5.0
"""Seconds without input after which an active node is stale."""


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """Status of a node when it reports.

    Attributes:
        state: of the lifecycle.
        problem: why the node could not be configured.
        counters: of the component.
        dropped: messages of each input dropped so far.
        publishers: number of publishers on each input topic.
    """

    state: str = "active"
    problem: str = ""
    counters: Mapping[str, float] = field(default_factory=dict)
    dropped: Mapping[str, int] = field(default_factory=dict)
    publishers: Mapping[str, int] = field(default_factory=dict)


class Diagnostics:
    """Counts messages and reports them; rates and latencies are those since the last report.

    A supervisor can act on the level:

    - OK: the node works, or is inactive on purpose.
    - WARN: it works, but messages are dropped or cannot be used.
    - ERROR: it could not be configured, or the processing of messages failed.
    - STALE: it is active, but receives nothing.
    """

    def __init__(self, node: str, component: str) -> None:
        """Make the diagnostics of `component` (a short name) in the node with the full name `node`."""
        self.people: int | None = None
        self.resets = 0
        self._name = f"{node.lstrip('/').replace('/', '.')}: {component}"
        self._hardware_id = node
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._latencies: list[float] = []
        self._dropped = 0
        self._unusable = 0
        self._failures = 0
        self._last_error: tuple[float, str] | None = None
        self._last_input = time.monotonic()
        self._has_input = False

    def reset_silence(self) -> None:
        """Restart the time without input: inputs may come from now on."""
        self._last_input, self._has_input, self.people = time.monotonic(), False, None

    def count_received(self, topic: str) -> None:
        """Count a received message."""
        self._last_input, self._has_input = time.monotonic(), True
        self.count_message(topic)

    def count_message(self, topic: str) -> None:
        """Count a message on `topic`, received or published."""
        with self._lock:
            self._counts[topic] += 1

    def record_latency(self, seconds: float) -> None:
        """Record the age of an input, by its stamp, when its results were published."""
        with self._lock:
            self._latencies.append(seconds)

    def record_failure(self, sentence: str) -> None:
        """Count a message whose processing raised an unexpected error."""
        with self._lock:
            self._failures += 1
            self._last_error = time.monotonic(), sentence

    def record_problem(self, sentence: str) -> None:
        """Record what was wrong with an input, a parameter or the set-up."""
        with self._lock:
            self._last_error = time.monotonic(), sentence

    def report(self, stamp: Any, seconds: float, now: NodeStatus) -> Any:
        """Return the DiagnosticArray of the `seconds` since the last report."""
        with self._lock:
            passed, self._counts = self._counts, Counter(dict.fromkeys(self._counts, 0))
            latencies, self._latencies = self._latencies, []
            failures, self._failures = self._failures, 0
            error = self._last_error
        dropped = sum(now.dropped.values())
        newly_dropped, self._dropped = max(0, dropped - self._dropped), dropped
        unusable = int(now.counters.get("unusable", 0))
        newly_unusable, self._unusable = max(0, unusable - self._unusable), unusable
        if now.problem:
            level, message = DiagnosticStatus.ERROR, f"the node cannot work: {now.problem}"
        elif now.state != "active":
            level, message = DiagnosticStatus.OK, f"{now.state}: nothing is processed until it is activated"
        elif failures or newly_unusable or newly_dropped:
            level, message = _describe_trouble(failures, newly_unusable, newly_dropped)
        else:
            level, message = self._assess_input(now.publishers)
        values = {"state": now.state}
        values |= {f"{topic} (Hz)": f"{count / seconds:.1f}" for topic, count in sorted(passed.items())}
        if latencies:
            values["latency median (s)"] = f"{statistics.median(latencies):.3f}"
            values["latency max (s)"] = f"{max(latencies):.3f}"
        if self.people is not None:
            values["people"] = str(self.people)
        values |= {f"dropped {topic}": str(count) for topic, count in sorted(now.dropped.items())}
        values |= {name: f"{value:g}" for name, value in sorted({**now.counters, "resets": self.resets}.items())}
        if error is not None:
            values["last error"] = error[1]
            values["last error (s ago)"] = f"{time.monotonic() - error[0]:.0f}"
        status = DiagnosticStatus(level=level, name=self._name, message=message, hardware_id=self._hardware_id)
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = stamp
        return array

    def _assess_input(self, publishers: Mapping[str, int]) -> tuple[bytes, str]:
        silent = time.monotonic() - self._last_input
        if silent > MAX_SILENCE_S:
            who = ", ".join(f"{topic} ({count})" for topic, count in publishers.items())
            return DiagnosticStatus.STALE, f"no message for {silent:.0f} s; topics and their publishers: {who}"
        return DiagnosticStatus.OK, "running" if self._has_input else "waiting for messages"


def _describe_trouble(failures: int, unusable: int, dropped: int) -> tuple[bytes, str]:
    if failures:
        return DiagnosticStatus.ERROR, f"{failures} messages failed; the last error says why"
    if unusable:
        return DiagnosticStatus.WARN, f"{unusable} messages could not be used; the last error says why"
    return DiagnosticStatus.WARN, f"too slow for its input: {dropped} messages dropped"
