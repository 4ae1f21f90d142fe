# SPDX-License-Identifier: Apache-2.0
"""ROS 1 bags (format 2.0): by their index, or without it if they were not closed, are cut or damaged."""

from __future__ import annotations

import io
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from rosbags.rosbag1 import Reader

from flowing_puppet_ros.bag.storage.compression import decompress_prefix
from flowing_puppet_ros.bag.storage.stored_file import ChunkSpan, StoredTopic, merge_chunks
from flowing_puppet_ros.errors import InputError

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
_MAX_HEADER_BYTES = 1 << 20


class Rosbag1File:
    """A ROS 1 bag that is read by its index."""

    def __init__(self, path: Path) -> None:
        """Open it; InputError if it has no index or is damaged."""
        self.path = path
        self.notes: list[str] = []
        self._reader = Reader(path)
        try:
            self._reader.open()
        except Exception as error:  # a damaged file makes the library raise anything
            if "encrypt" in str(error):
                raise InputError(f"{path} is encrypted: `rosbag decrypt` of ROS 1 writes one that is not") from error
            raise InputError(f"{path} was not closed, is cut off or damaged: add --salvage to read the rest") from error
        self._connections = list(self._reader.connections)
        self.topics = [
            _describe_topic(
                connection.topic, connection.msgtype, str(connection.msgdef.data).encode(), connection.msgcount
            )
            for connection in self._connections
        ]

    def messages(self, chosen: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        """Yield (index in `topics`, log time, bytes) of some topics' messages in log order."""
        indices = {self._connections[index].id: index for index in chosen}
        if not indices:
            return
        try:
            for connection, log_time, raw in self._reader.messages([self._connections[index] for index in chosen]):
                yield indices[connection.id], log_time, raw
        except Exception as error:  # as above
            reason = str(error).rstrip(".") or type(error).__name__
            raise InputError(f"{self.path} is damaged: {reason}; add --salvage to read the rest") from error

    def close(self) -> None:
        """Close the file."""
        self._reader.close()


class ScannedRosbag1File:
    """A ROS 1 bag without a usable index: every whole message in it is found by a scan."""

    def __init__(self, path: Path) -> None:
        """Scan the file; damaged chunks are passed over, of a cut one the whole messages are read."""
        self.path = path
        self._damaged = 0
        self._chunks: list[ChunkSpan] = []
        self._connections: dict[int, dict[str, bytes]] = {}
        self._counts: Counter[int] = Counter()
        self._size = path.stat().st_size
        with path.open("rb") as stream:
            self._scan(stream)
        self._numbers = sorted(self._connections)
        self.topics = [
            _describe_topic(
                _read_text(self._connections[number], "topic"),
                _read_text(self._connections[number], "type"),
                self._connections[number].get("message_definition", b""),
                self._counts[number],
            )
            for number in self._numbers
        ]
        damage = f", {self._damaged} damaged places passed over" if self._damaged else ""
        self.notes = [f"{path}: {sum(self._counts.values())} messages salvaged{damage}"]

    def messages(self, chosen: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        """Yield (index in `topics`, log time, bytes) of some topics' messages in log order."""
        indices = {self._numbers[index]: index for index in chosen}
        with self.path.open("rb") as stream:

            def unpack(chunk: ChunkSpan) -> Iterator[tuple[int, int, bytes]]:
                for fields, data in self._read_chunk(stream, chunk.offset):
                    number = _read_uint(fields, "conn")
                    if fields.get("op") == bytes([_MESSAGE]) and number in indices:
                        yield indices[number], _read_time(fields), data

            yield from merge_chunks(self._chunks, unpack)

    def close(self) -> None:
        """Do nothing: it is open only while it is read."""

    def _scan(self, stream: BinaryIO) -> None:
        offset = len(MAGIC)
        while offset < self._size:
            stream.seek(offset)
            fields, length = _read_head(stream)
            if fields is None:
                self._damaged += offset < self._size - 4
                return
            start = stream.tell()
            if fields.get("op") == bytes([_CHUNK]):
                self._index_chunk(stream, offset, start + length > self._size)
            offset = start + length

    def _index_chunk(self, stream: BinaryIO, offset: int, cut: bool) -> None:
        times = []
        try:
            for fields, data in self._read_chunk(stream, offset):
                if fields.get("op") == bytes([_CONNECTION]):
                    self._connections.setdefault(_read_uint(fields, "conn"), fields | _parse_fields(data))
                elif fields.get("op") == bytes([_MESSAGE]):
                    times.append(_read_time(fields))
                    self._counts[_read_uint(fields, "conn")] += 1
        except (KeyError, struct.error):
            self._damaged += 1
        self._damaged += not (times or cut)
        if times:
            self._chunks.append(ChunkSpan(min(times), max(times), offset, 0, cut))

    @staticmethod
    def _read_chunk(stream: BinaryIO, offset: int) -> Iterator[tuple[dict[str, bytes], bytes]]:
        """Yield the records of a chunk up to the first that is not whole."""
        stream.seek(offset)
        head, length = _read_head(stream)
        packed = stream.read(length)
        unpacked = io.BytesIO(decompress_prefix(_read_text(head or {}, "compression"), packed))
        while True:
            fields, length = _read_head(unpacked)
            data = unpacked.read(length)
            if fields is None or len(data) < length:
                return
            yield fields, data


def _describe_topic(topic: str, kind: str, schema: bytes, count: int) -> StoredTopic:
    return StoredTopic(f"/{topic.strip('/')}", kind, "ros1", "ros1msg", schema, count)


def _read_head(stream: BinaryIO) -> tuple[dict[str, bytes] | None, int]:
    """Return the fields of the next record's head and the length of its data; None if it is not whole."""
    try:
        (length,) = struct.unpack("<I", stream.read(4))
        head = stream.read(length) if length <= _MAX_HEADER_BYTES else b""
        if len(head) < length or not length:
            return None, 0
        return _parse_fields(head), struct.unpack("<I", stream.read(4))[0]
    except (struct.error, UnicodeDecodeError):
        return None, 0


def _parse_fields(head: bytes) -> dict[str, bytes]:
    """Return name -> value of the fields of a head; struct.error if it is none."""
    fields, place = {}, 0
    while place < len(head):
        (length,) = struct.unpack_from("<I", head, place)
        name, separator, value = head[place + 4 : place + 4 + length].partition(b"=")
        if not separator:
            raise struct.error("a field without a value")
        fields[name.decode("ascii")] = value
        place += 4 + length
    return fields


def _read_uint(fields: dict[str, bytes], name: str) -> int:
    return int(struct.unpack("<I", fields[name])[0])


def _read_time(fields: dict[str, bytes]) -> int:
    seconds, rest = struct.unpack("<II", fields["time"])
    return int(seconds) * 10**9 + int(rest)


def _read_text(fields: dict[str, Any], name: str) -> str:
    return bytes(fields.get(name, b"")).decode("utf8", "replace")
