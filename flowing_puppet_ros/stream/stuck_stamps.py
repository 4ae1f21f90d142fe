# SPDX-License-Identifier: Apache-2.0
"""Stamps that do not advance, as of drivers without a clock, replaced by the times of recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from flowing_puppet_ros.stream.messages.geometry import stamp_ns
from flowing_puppet_ros.units import NANOSECONDS


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
