# SPDX-License-Identifier: Apache-2.0
"""The first messages of each topic: rates, stamps, frames, and whether they can be decoded."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flowing_puppet_ros.bag.depth_topics import holds_depth, image_encoding
from flowing_puppet_ros.bag.reader import RecordingLike
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.clouds import decode_cloud
from flowing_puppet_ros.stream.messages.depth import back_project
from flowing_puppet_ros.stream.messages.geometry import stamp_ns
from flowing_puppet_ros.stream.messages.images import decode_depth, decode_image
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, POINT_CLOUD
from flowing_puppet_ros.units import NANOSECONDS

MAX_MESSAGES = 60
"""Messages of each topic that are looked at."""
MAX_BYTES = 1_000_000_000
"""Bytes of all messages that are looked at."""
BACK_SHARE = 0.05
"""Share of stamps that lie before their predecessor's from which on it is said."""


@dataclass(slots=True)
class TopicSample:
    """The first messages of a topic: when they were recorded and stamped, ns, in what frames, and the first of them."""

    type: str
    count: int
    log_times: list[int] = field(default_factory=list)
    stamps: list[int] = field(default_factory=list)
    frames: set[str] = field(default_factory=set)
    first: Any = None
    unreadable: str = ""

    @property
    def rate(self) -> float | None:
        """Messages a second by the times of recording; None if too few are known."""
        span = self.log_times[-1] - self.log_times[0] if len(self.log_times) > 1 else 0
        return (len(self.log_times) - 1) * NANOSECONDS / span if span > 0 else None

    def describe_rate(self) -> str:
        """Return number and rate for a sentence."""
        rate = "" if self.rate is None else f", {self.rate:.1f} Hz"
        return f" ({self.count} messages{rate})"


@dataclass(frozen=True, slots=True)
class Fault:
    """What is wrong with the messages of a topic; whether that prevents results; the command that mends it, or ""."""

    sentence: str
    prevents: bool = False
    command: str = ""


def sample_topics(recording: RecordingLike, names: Collection[str]) -> dict[str, TopicSample]:
    """Return topic -> its first messages, for those of `names` that are in the recording."""
    details = recording.details
    found = {name: TopicSample(details[name].type, details[name].count) for name in names if name in details}
    missing = {name: min(MAX_MESSAGES, sample.count) for name, sample in found.items() if sample.count}
    size = 0
    for record in recording.messages(list(missing)) if missing else ():
        size += len(record.raw)
        if missing.get(record.topic, 0) > 0:
            missing[record.topic] -= 1
            _add(found[record.topic], record)
        if not any(missing.values()) or size > MAX_BYTES:
            break
    return found


def _add(sample: TopicSample, record: Any) -> None:
    sample.log_times.append(record.log_time)
    try:
        message = record.message
    except InputError as error:
        sample.unreadable = sample.unreadable or str(error)
        return
    if sample.first is None:
        sample.first = message
    if hasattr(message, "header"):
        sample.stamps.append(stamp_ns(message))
        sample.frames.add(message.header.frame_id)


def describe_faults(name: str, sample: TopicSample, info: TopicSample | None = None) -> list[Fault]:
    """Return what is wrong with the first messages of a topic; `info` is that of the camera_info of depth images."""
    if sample.first is None:
        return [Fault(sample.unreadable, True)] if sample.unreadable else []
    faults = []
    try:
        _decode(name, sample, info)
    except InputError as error:
        faults.append(Fault(str(error), True))
    if sample.type not in (IMAGE, COMPRESSED_IMAGE, POINT_CLOUD, CAMERA_INFO):
        return faults
    if sample.type != CAMERA_INFO:
        faults += _describe_stamps(sample)
    if "" in sample.frames:
        faults.append(
            Fault("the frame_id is empty, so results have no place among the other frames; set it in the driver")
        )
    if len(sample.frames) > 1:
        faults.append(Fault(f"the messages are in different frames ({', '.join(sorted(sample.frames))})"))
    return faults


def _decode(name: str, sample: TopicSample, info: TopicSample | None) -> None:
    """Decode the first message as the component will; InputError if that fails."""
    message = sample.first
    if sample.type == POINT_CLOUD:
        if not np.any(np.isfinite(decode_cloud(message)[0]).all(axis=1)):
            raise InputError("the first cloud has no finite point")
    elif sample.type == CAMERA_INFO and not np.any(message.k) and not np.any(message.p):
        raise InputError("the camera_info is uncalibrated (k and p are all zero); publish a calibrated camera_info")
    elif sample.type in (IMAGE, COMPRESSED_IMAGE):
        if holds_depth(name, image_encoding(name, message)):
            depth = decode_depth(message)
            if info is not None and info.first is not None and not len(back_project(depth, info.first)):
                raise InputError("the first depth image has no pixel with a depth")
        else:
            decode_image(message)


def _describe_stamps(sample: TopicSample) -> list[Fault]:
    stamps = np.array(sample.stamps, np.int64)
    if not np.any(stamps):
        return [Fault("all stamps are zero, so nothing can be matched with other topics; set the stamp in the driver")]
    steps = np.diff(stamps)
    if len(steps) and not np.any(steps):
        return [Fault("all messages have one stamp: they are taken in the order and at the times of recording")]
    faults = []
    if len(steps) and np.mean(steps < 0) > BACK_SHARE:
        faults.append(
            Fault(f"{np.mean(steps < 0):.0%} of the stamps are before their predecessor's: tracks restart there")
        )
    if len(steps) and np.mean(steps == 0) > BACK_SHARE:
        faults.append(Fault(f"{np.mean(steps == 0):.0%} of the stamps are those of the message before"))
    return faults


def compare_clocks(name: str, sample: TopicSample, other_name: str, other: TopicSample) -> str:
    """Return a sentence if the stamps of two topics that belong together are of different clocks, else ""."""
    if not sample.stamps or not other.stamps or not any(other.stamps):
        return ""
    gap = max(min(sample.stamps) - max(other.stamps), min(other.stamps) - max(sample.stamps))
    recorded = max(
        min(sample.log_times) - max(other.log_times), min(other.log_times) - max(sample.log_times), NANOSECONDS
    )
    if gap <= 2 * recorded:
        return ""
    return (
        f"the stamps on {name} and {other_name} are {gap / NANOSECONDS:.3g} s apart, so they are of different clocks"
        " and are not matched: synchronise the clocks of their drivers"
    )
