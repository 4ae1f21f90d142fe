# SPDX-License-Identifier: Apache-2.0
"""Latency of the results in a bag, and dropped inputs."""

from __future__ import annotations

import struct

import numpy as np

from flowing_puppet_ros.bag.reader import Bag, Record
from flowing_puppet_ros.evaluate.bag.recording import RESULT_LEAVES, leaf, namespace
from flowing_puppet_ros.stream.messages.message_types import (
    BODIES,
    COMPRESSED_IMAGE,
    IMAGE,
    POINT_CLOUD,
    PUPPETS,
    SILHOUETTES,
)

Times = dict[int, int]  # stamp -> log time, both ns


def measure_timing(input_bag: Bag, output_bag: Bag) -> dict[str, float]:
    """Measure the latency of puppets and bodies, and count images and clouds without a result.

    Latency is the time from recording the last input of a stamp to recording its result. A replay records results at
    the time of the message that completed them, so there latency is the time spent waiting for that message.
    """
    sensors = {
        name: _read_times(input_bag, name)
        for name, kind in input_bag.topics.items()
        if kind in (IMAGE, COMPRESSED_IMAGE, POINT_CLOUD) and leaf(name) not in RESULT_LEAVES
    }
    arrived: Times = {}
    for times in sensors.values():
        for stamp, time in times.items():
            arrived[stamp] = max(time, arrived.get(stamp, time))
    figures: dict[str, float] = {}
    for label, role, unit in (("puppets", PUPPETS, "images"), ("bodies", BODIES, "clouds")):
        topics = [name for name, kind in output_bag.topics.items() if kind == role and leaf(name) == label]
        results = {topic: _read_times(output_bag, topic) for topic in topics}
        late = [(time - arrived.get(stamp, stamp)) * 1e-9 for one in results.values() for stamp, time in one.items()]
        if late:
            figures[f"latency of {label}, median s"] = float(np.median(late))
            figures[f"latency of {label}, 95 % s"] = float(np.percentile(late, 95))
        wanted = {topic: _expected_stamps(topic, role, sensors, input_bag, output_bag) for topic in topics}
        if any(wanted.values()):
            figures[unit] = float(sum(map(len, wanted.values())))
            figures[f"{unit} dropped"] = float(sum(len(wanted[topic] - results[topic].keys()) for topic in topics))
    return figures


def _expected_stamps(topic: str, role: str, sensors: dict[str, Times], input_bag: Bag, output_bag: Bag) -> set[int]:
    """Return the stamps that need a result on a topic: of images or clouds beside it, or of sets of silhouettes."""
    clouds = role == BODIES
    beside = {
        stamp
        for name, times in sensors.items()
        if namespace(name) == namespace(topic) and (input_bag.topics[name] == POINT_CLOUD) == clouds
        for stamp in times
    }
    if beside or not clouds:
        return beside
    return {
        stamp
        for name, kind in output_bag.topics.items()
        if kind == SILHOUETTES
        for stamp in _read_times(output_bag, name)
    }


def _read_times(bag: Bag, topic: str) -> Times:
    """Read when each stamp of a topic was first recorded."""
    times: Times = {}
    for record in bag.messages([topic]):
        times.setdefault(_read_stamp(record), record.log_time)
    return times


def _read_stamp(record: Record) -> int:
    """Read the stamp (ns) of a message that starts with a header, without decoding the message."""
    seconds, nanoseconds = struct.unpack_from("<iI" if record.raw[1] & 1 else ">iI", record.raw, 4)
    return int(seconds) * 10**9 + int(nanoseconds)
