# SPDX-License-Identifier: Apache-2.0
"""What /diagnostics says: rates over the period, new drops and failures set the level."""

import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus

from flowing_puppet_ros.node.diagnostics import Diagnostics

pytestmark = pytest.mark.ros


def values(report: object) -> dict[str, str]:
    """Return the key-value pairs of a report."""
    return {item.key: item.value for item in report.status[0].values}  # type: ignore[attr-defined]


def test_rates_latency_and_counters() -> None:
    diagnostics = Diagnostics("/cam01/puppet_tracker", "puppet_tracker")
    for _ in range(30):
        diagnostics.passed("image")
    diagnostics.took(0.1)
    diagnostics.took(0.3)
    report = diagnostics.report(Time(sec=5), 2.0, {"images": 30}, {})
    assert report.header.stamp.sec == 5
    assert report.status[0].name == "cam01.puppet_tracker: puppet_tracker"
    assert report.status[0].level == DiagnosticStatus.OK
    assert values(report) == {
        "image (Hz)": "15.0", "latency mean (s)": "0.200", "latency max (s)": "0.300", "images": "30",
    }  # fmt: skip
    silent = diagnostics.report(Time(), 1.0, {}, {})
    assert values(silent) == {"image (Hz)": "0.0"}
    assert silent.status[0].message == "waiting for messages"


def test_level_follows_what_is_new() -> None:
    diagnostics = Diagnostics("/a", "a")
    assert diagnostics.report(Time(), 1.0, {}, {"image": 3}).status[0].level == DiagnosticStatus.WARN
    assert diagnostics.report(Time(), 1.0, {}, {"image": 3}).status[0].level == DiagnosticStatus.OK
    unusable = diagnostics.report(Time(), 1.0, {"unusable": 2}, {"image": 3}).status[0]
    assert (unusable.level, unusable.message[:1]) == (DiagnosticStatus.WARN, "2")
    assert diagnostics.report(Time(), 1.0, {"unusable": 2}, {"image": 3}).status[0].level == DiagnosticStatus.OK
    diagnostics.failed()
    assert diagnostics.report(Time(), 1.0, {}, {"image": 3}).status[0].level == DiagnosticStatus.ERROR
