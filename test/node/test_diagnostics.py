# SPDX-License-Identifier: Apache-2.0
"""What /diagnostics says: rates over the period, new drops and failures set the level."""

from typing import Any

import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus

from flowing_puppet_ros.node.diagnostics import MAX_SILENCE_S, Diagnostics, NodeStatus

pytestmark = pytest.mark.ros


def values(report: object) -> dict[str, str]:
    """Return the key-value pairs of a report."""
    return {item.key: item.value for item in report.status[0].values}  # type: ignore[attr-defined]


def test_rates_latency_and_counters() -> None:
    diagnostics = Diagnostics("/cam01/puppet_tracker", "puppet_tracker")
    for _ in range(30):
        diagnostics.count_received("image")
    for seconds in (0.1, 0.1, 0.4):
        diagnostics.record_latency(seconds)
    diagnostics.people = 2
    report = diagnostics.report(Time(sec=5), 2.0, NodeStatus(counters={"images": 30}))
    assert report.header.stamp.sec == 5
    assert report.status[0].name == "cam01.puppet_tracker: puppet_tracker"
    assert report.status[0].level == DiagnosticStatus.OK
    assert values(report) == {
        "state": "active", "image (Hz)": "15.0", "latency median (s)": "0.100", "latency max (s)": "0.400",
        "people": "2", "images": "30", "resets": "0",
    }  # fmt: skip
    quiet = values(diagnostics.report(Time(), 1.0, NodeStatus()))
    assert quiet["image (Hz)"] == "0.0" and "latency median (s)" not in quiet


def level(diagnostics: Diagnostics, **condition: Any) -> tuple[bytes, str]:
    """Return level and message of a report."""
    status = diagnostics.report(Time(), 1.0, NodeStatus(**condition)).status[0]
    return status.level, status.message


def test_level_follows_what_is_new() -> None:
    diagnostics = Diagnostics("/a", "a")
    assert level(diagnostics) == (DiagnosticStatus.OK, "waiting for messages")
    assert level(diagnostics, dropped={"image": 3})[0] == DiagnosticStatus.WARN
    assert level(diagnostics, dropped={"image": 3})[0] == DiagnosticStatus.OK
    unusable = level(diagnostics, counters={"unusable": 2}, dropped={"image": 3})
    assert (unusable[0], unusable[1][:1]) == (DiagnosticStatus.WARN, "2")
    assert level(diagnostics, counters={"unusable": 2}, dropped={"image": 3})[0] == DiagnosticStatus.OK
    diagnostics.record_failure("ZeroDivisionError: it broke")
    report = diagnostics.report(Time(), 1.0, NodeStatus())
    assert report.status[0].level == DiagnosticStatus.ERROR
    assert values(report)["last error"] == "ZeroDivisionError: it broke"
    # A component that was made anew counts from zero.
    assert level(diagnostics, counters={"unusable": 0})[0] == DiagnosticStatus.OK


def test_states_and_silence_have_their_levels(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("flowing_puppet_ros.node.diagnostics.time.monotonic", lambda: now[0])
    diagnostics = Diagnostics("/a", "a")
    diagnostics.count_received("image")
    now[0] += 2 * MAX_SILENCE_S
    stale = level(diagnostics, publishers={"/camera/image": 0})
    assert stale == (DiagnosticStatus.STALE, "no message for 10 s; topics and their publishers: /camera/image (0)")
    assert level(diagnostics, state="inactive")[0] == DiagnosticStatus.OK
    diagnostics.reset_silence()
    assert level(diagnostics) == (DiagnosticStatus.OK, "waiting for messages")
    broken = level(diagnostics, state="unconfigured", problem="cameras is empty")
    assert broken == (DiagnosticStatus.ERROR, "the node cannot work: cameras is empty")
