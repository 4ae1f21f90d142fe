# SPDX-License-Identifier: Apache-2.0
"""How late the results in a bag came, and for which inputs none came at all."""

from __future__ import annotations

import struct

import numpy as np

from flowing_puppet_ros.bag.reader import Bag, Record
from flowing_puppet_ros.evaluate.bag.recording import BODIES, CLOUD, IMAGE, MADE, PUPPETS, leaf, namespace
from flowing_puppet_ros.stream.messages.message_types import SILHOUETTES

Times = dict[int, int]  # stamp -> log time, both ns


def timing(given: Bag, made: Bag) -> dict[str, float]:
    """Latency of puppets and bodies, and how many images and clouds have no answer.

    Latency is from the moment at which the last input of a stamp was recorded to that at which its result was; of a
    replay, whose results are recorded at the time of the message that completed them, it is what they waited for.
    """
    sensors = {
        name: _times(given, name)
        for name, kind in given.topics.items()
        if (kind in IMAGE or kind == CLOUD) and leaf(name) not in MADE
    }
    arrived: Times = {}
    for times in sensors.values():
        for stamp, time in times.items():
            arrived[stamp] = max(time, arrived.get(stamp, time))
    figures: dict[str, float] = {}
    for label, role, unit in (("puppets", PUPPETS, "images"), ("bodies", BODIES, "clouds")):
        topics = [name for name, kind in made.topics.items() if kind == role and leaf(name) == label]
        results = {topic: _times(made, topic) for topic in topics}
        late = [(time - arrived.get(stamp, stamp)) * 1e-9 for one in results.values() for stamp, time in one.items()]
        if late:
            figures[f"latency of {label}, median s"] = float(np.median(late))
            figures[f"latency of {label}, 95 % s"] = float(np.percentile(late, 95))
        wanted = {topic: _inputs(topic, role, sensors, given, made) for topic in topics}
        if any(wanted.values()):
            figures[unit] = float(sum(map(len, wanted.values())))
            figures[f"{unit} dropped"] = float(sum(len(wanted[topic] - results[topic].keys()) for topic in topics))
    return figures


def _inputs(topic: str, role: str, sensors: dict[str, Times], given: Bag, made: Bag) -> set[int]:
    """Stamps that a topic of results should answer: of images or clouds beside it, or of sets of silhouettes."""
    clouds = role == BODIES
    beside = {
        stamp
        for name, times in sensors.items()
        if namespace(name) == namespace(topic) and (given.topics[name] == CLOUD) == clouds
        for stamp in times
    }
    if beside or not clouds:
        return beside
    return {stamp for name, kind in made.topics.items() if kind == SILHOUETTES for stamp in _times(made, name)}


def _times(bag: Bag, topic: str) -> Times:
    """When each stamp of a topic was recorded, first."""
    times: Times = {}
    for record in bag.messages([topic]):
        times.setdefault(_stamp(record), record.log_time)
    return times


def _stamp(record: Record) -> int:
    """The stamp of a message that starts with a header; images need not be read for it."""
    seconds, nanoseconds = struct.unpack_from("<iI" if record.raw[1] & 1 else ">iI", record.raw, 4)
    return int(seconds) * 10**9 + int(nanoseconds)
