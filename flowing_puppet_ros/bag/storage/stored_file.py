# SPDX-License-Identifier: Apache-2.0
"""What every file of a recording offers: topics as they were written, and messages in log order."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError


@dataclass(frozen=True, slots=True)
class StoredTopic:
    """One channel of a file.

    Attributes:
        topic: its name.
        type: the name of its type, as written.
        encoding: of its messages: cdr, ros1, json, protobuf.
        schema_encoding: ros2msg, ros2idl, ros1msg, jsonschema, protobuf; empty if there is no schema.
        schema: the definition of its type.
        count: number of its messages.
        qos: the QoS profiles that were offered.
    """

    topic: str
    type: str
    encoding: str
    schema_encoding: str
    schema: bytes
    count: int
    qos: tuple[dict[str, Any], ...] = ()


class StoredFile(Protocol):
    """One open file; `notes` say what was salvaged or could not be read."""

    topics: list[StoredTopic]
    notes: list[str]

    def messages(self, chosen: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        """Yield (index in `topics`, log time in ns, bytes) of some topics' messages in log order."""

    def close(self) -> None:
        """Close it, and delete what was unpacked for it."""


@dataclass(frozen=True, slots=True)
class ChunkSpan:
    """A chunk: the log times (ns) of its first and last message, its offset and length in bytes, whether it is cut."""

    first: int
    last: int
    offset: int
    length: int
    cut: bool = False


def merge_chunks(
    chunks: Iterable[ChunkSpan], unpack: Callable[[ChunkSpan], Iterable[tuple[int, int, bytes]]]
) -> Iterator[tuple[int, int, bytes]]:
    """Yield the (channel, log time, bytes) of all chunks in log order; only overlapping chunks are kept in memory."""
    pending: list[tuple[int, int, int, bytes]] = []
    order = 0
    for chunk in sorted(chunks, key=lambda chunk: (chunk.first, chunk.offset)):
        while pending and pending[0][0] < chunk.first:
            time, _, number, data = heapq.heappop(pending)
            yield number, time, data
        for number, time, data in unpack(chunk):
            heapq.heappush(pending, (time, order, number, data))
            order += 1
    while pending:
        time, _, number, data = heapq.heappop(pending)
        yield number, time, data


def parse_qos(text: str) -> tuple[dict[str, Any], ...]:
    """Return the QoS profiles that rosbag2 writes as YAML; none if it is no such text."""
    return tuple(dict(item) for item in _parse_profiles(text))


@lru_cache(maxsize=256)
def _parse_profiles(text: str) -> tuple[dict[str, Any], ...]:
    """Parse the text once for all topics that have the same: a bag has dozens of topics."""
    try:
        return tuple(dict(item) for item in YAML(typ="safe").load(text) or ())
    except (YAMLError, TypeError, ValueError):
        return ()
