# SPDX-License-Identifier: Apache-2.0
"""Stamps that do not advance, as of drivers without a clock: the times of recording, or even steps, instead."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from flowing_puppet_ros.reporting import Report
from flowing_puppet_ros.stream.messages.geometry import stamp_ns
from flowing_puppet_ros.units import NANOSECONDS

ASSUMED_INTERVAL_NS = 100_000_000
"""Between clouds whose stamps do not advance (drivers that stamp nothing)."""


@dataclass(slots=True)
class _TopicStamps:
    """Stamp and time of recording of a topic's first message, ns; whether the second has the same stamp, once known."""

    stamp: int
    log_time: int
    stuck: bool | None = None


class StuckStamps:
    """Advances the stamps of topics whose first two messages have the same.

    The first message keeps its stamp; those after it are as much later as they were recorded later.
    """

    def __init__(self) -> None:
        """Start with no topic."""
        self._topics: dict[str, _TopicStamps] = {}

    def advance(self, topic: str, log_time: int, message: Any) -> list[str]:
        """Set the stamp of the next message of a topic if its stamps are stuck; return a sentence when that begins."""
        stamp = stamp_ns(message)
        first = self._topics.setdefault(topic, _TopicStamps(stamp, log_time))
        if first.stuck is False or first.log_time == log_time:
            return []
        begins = first.stuck is None
        first.stuck = first.stuck or stamp == first.stamp
        if not first.stuck:
            return []
        seconds, rest = divmod(first.stamp + log_time - first.log_time, NANOSECONDS)
        message.header.stamp.sec, message.header.stamp.nanosec = seconds, rest
        sentence = f"the messages on {topic} all have one stamp: they follow one another by their times of recording"
        return [sentence] if begins else []


class CloudClock:
    """Tells the times of the clouds of a stream, which advance even where their stamps do not."""

    def __init__(self, report: Report) -> None:
        """Start with no cloud; `report` is told of stamps that come twice."""
        self._report = report
        self._last: tuple[int, int] | None = None

    def reset(self) -> None:
        """Forget the clouds."""
        self._last = None

    def advance(self, stamp: int) -> int:
        """Return the time of a cloud, ns: its stamp, or some time after the cloud before it if that has the same."""
        earlier, self._last = self._last, (stamp, stamp)
        if earlier is None or stamp != earlier[0]:
            return stamp
        self._report.warn(
            f"two clouds have the stamp {stamp} ns: they are taken as {ASSUMED_INTERVAL_NS * 1e-9:g} s apart"
        )
        self._last = stamp, earlier[1] + ASSUMED_INTERVAL_NS
        return self._last[1]
