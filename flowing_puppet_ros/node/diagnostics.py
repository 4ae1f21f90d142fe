# SPDX-License-Identifier: Apache-2.0
"""What a node says about itself on /diagnostics: rates, counters, drops and latency (REP-107)."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue


class Diagnostics:
    """Counts what passes and reports it, the rates over the time since the last report."""

    def __init__(self, node: str, component: str) -> None:
        """Make the diagnostics of `component` (a short name) in the node with the full name `node`."""
        self._name = f"{node.lstrip('/').replace('/', '.')}: {component}"
        self._hardware_id = node
        self._lock = threading.Lock()
        self._passed: Counter[str] = Counter()
        self._latencies: list[float] = []
        self._dropped = 0
        self._unusable = 0
        self._failures = 0

    def passed(self, topic: str) -> None:
        """Count a message that came in or went out."""
        with self._lock:
            self._passed[topic] += 1

    def took(self, seconds: float) -> None:
        """Note the age of an input, by its stamp, when its results went out."""
        with self._lock:
            self._latencies.append(seconds)

    def failed(self) -> None:
        """Count a message whose processing raised an unexpected error."""
        with self._lock:
            self._failures += 1

    def report(self, stamp: Any, seconds: float, counters: Mapping[str, float], dropped: Mapping[str, int]) -> Any:
        """Return the DiagnosticArray of the `seconds` since the last report.

        `counters` are the component's, `dropped` the messages dropped so far of each input.
        """
        with self._lock:
            passed, self._passed = self._passed, Counter(dict.fromkeys(self._passed, 0))
            latencies, self._latencies = self._latencies, []
            failures, self._failures = self._failures, 0
        newly_dropped, self._dropped = sum(dropped.values()) - self._dropped, sum(dropped.values())
        unusable = int(counters.get("unusable", 0))
        newly_unusable, self._unusable = unusable - self._unusable, unusable
        level, message = _verdict(failures, newly_unusable, newly_dropped, sum(passed.values()))
        values = {f"{topic} (Hz)": f"{count / seconds:.1f}" for topic, count in sorted(passed.items())}
        if latencies:
            values["latency mean (s)"] = f"{sum(latencies) / len(latencies):.3f}"
            values["latency max (s)"] = f"{max(latencies):.3f}"
        values |= {f"dropped {topic}": str(count) for topic, count in sorted(dropped.items())}
        values |= {name: f"{value:g}" for name, value in sorted(counters.items())}
        status = DiagnosticStatus(level=level, name=self._name, message=message, hardware_id=self._hardware_id)
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = stamp
        return array


def _verdict(failures: int, unusable: int, dropped: int, passed: int) -> tuple[bytes, str]:
    if failures:
        return DiagnosticStatus.ERROR, f"{failures} messages failed; the log says why"
    if unusable:
        return DiagnosticStatus.WARN, f"{unusable} messages could not be used; the log says why"
    if dropped:
        return DiagnosticStatus.WARN, f"too slow: {dropped} messages dropped"
    return DiagnosticStatus.OK, "running" if passed else "waiting for messages"
