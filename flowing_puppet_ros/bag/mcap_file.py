# SPDX-License-Identifier: Apache-2.0
"""One MCAP file read without its index, in log order, even if it is incomplete, truncated or damaged.

A scan finds the positions and times of the chunks and of the messages outside of chunks. Reading then keeps only
chunks with overlapping times in memory.
"""

from __future__ import annotations

import heapq
import io
import re
import struct
from array import array
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import breakup_chunk

from flowing_puppet_ros.errors import InputError

MAGIC = b"\x89MCAP0\r\n"
MAX_RECORD_BYTES = 1 << 30
"""Maximum size of a record or chunk."""
_RECORD_HEADER = struct.Struct("<BQ")
_COMPRESSION_OFFSET = _RECORD_HEADER.size + 8 + 8 + 8 + 4
"""Bytes of a chunk record before the name of its compression."""
_CHUNK_MARK = re.compile(rb"\x04\x00\x00\x00zstd|\x03\x00\x00\x00lz4")
_SEARCH_BYTES = 1 << 20
"""Bytes that are searched at a time for the next chunk."""


@dataclass(frozen=True, slots=True)
class _ChunkSpan:
    """A chunk: the log times (ns) of its first and last message, its offset, and the length of its data in bytes."""

    first: int
    last: int
    offset: int
    length: int


def is_mcap(path: Path) -> bool:
    """Return whether `path` starts with the MCAP magic bytes."""
    with path.open("rb") as stream:
        return stream.read(len(MAGIC)) == MAGIC


def is_truncated(path: Path) -> bool:
    """Return whether `path` starts but does not end with the MCAP magic bytes."""
    if not is_mcap(path):
        return False
    with path.open("rb") as stream:
        stream.seek(0, io.SEEK_END)
        if stream.tell() < 2 * len(MAGIC):
            return True
        stream.seek(-len(MAGIC), io.SEEK_END)
        return stream.read() != MAGIC


class McapFile:
    """The messages of one file.

    Attributes:
        channels: by id; only those whose messages are CDR of a named type.
        types: message type of each channel, by id.
        definitions: text of the type's definition, by id of the channel; only those in the form of `.msg` files.
        counts: number of messages of each channel, by id.
        damaged: chunks and records that could not be read.
        skipped_bytes: bytes that were skipped because of damage.
    """

    def __init__(self, path: Path, salvage: bool = False) -> None:
        """Scan the file. Damage is skipped with `salvage`, otherwise it is an InputError."""
        self.path = path
        self.channels: dict[int, Channel] = {}
        self.counts: Counter[int] = Counter()
        self.damaged = 0
        self.skipped_bytes = 0
        self._salvage = salvage
        self._schemas: dict[int, Schema] = {}
        self._chunks: list[_ChunkSpan] = []
        # Log times and offsets of the messages outside of chunks.
        self._times, self._offsets = array("Q"), array("Q")
        self._size = path.stat().st_size
        with path.open("rb") as stream:
            self._scan(stream)
        usable = {number for number, channel in self.channels.items() if self._is_usable(channel)}
        self.channels = {number: self.channels[number] for number in sorted(usable)}
        schemas = {number: self._schemas[channel.schema_id] for number, channel in self.channels.items()}
        self.types = {number: schema.name for number, schema in schemas.items()}
        self.definitions = {
            number: schema.data.decode("utf8", "replace")
            for number, schema in schemas.items()
            if schema.encoding == "ros2msg"
        }

    def messages(self, numbers: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        """Yield (channel id, log time, bytes) of the messages of some channels in the order of log times."""
        chosen = set(numbers)
        with self.path.open("rb") as loose, self.path.open("rb") as chunked:
            yield from heapq.merge(
                self._read_loose(loose, chosen), self._read_chunks(chunked, chosen), key=lambda item: item[1]
            )

    def _is_usable(self, channel: Channel) -> bool:
        return channel.message_encoding == "cdr" and channel.schema_id in self._schemas

    def _read_loose(self, stream: BinaryIO, chosen: set[int]) -> Iterator[tuple[int, int, bytes]]:
        for index in sorted(range(len(self._times)), key=self._times.__getitem__):
            stream.seek(self._offsets[index])
            message = _parse(*self._read_record(stream))
            if isinstance(message, Message) and message.channel_id in chosen:
                yield message.channel_id, message.log_time, message.data

    def _read_chunks(self, stream: BinaryIO, chosen: set[int]) -> Iterator[tuple[int, int, bytes]]:
        pending: list[tuple[int, int, int, bytes]] = []
        order = 0
        for chunk in sorted(self._chunks, key=lambda chunk: (chunk.first, chunk.offset)):
            while pending and pending[0][0] < chunk.first:
                time, _, number, data = heapq.heappop(pending)
                yield number, time, data
            stream.seek(chunk.offset)
            for message in _unpack_chunk(*self._read_record(stream)):
                if isinstance(message, Message) and message.channel_id in chosen:
                    heapq.heappush(pending, (message.log_time, order, message.channel_id, message.data))
                    order += 1
        while pending:
            time, _, number, data = heapq.heappop(pending)
            yield number, time, data

    def _scan(self, stream: BinaryIO) -> None:
        end_of_records = self._size if self._salvage else self._size - len(MAGIC)
        offset = len(MAGIC)
        while offset + _RECORD_HEADER.size <= end_of_records:
            stream.seek(offset)
            code, length = _RECORD_HEADER.unpack(stream.read(_RECORD_HEADER.size))
            end = offset + _RECORD_HEADER.size + length
            if code == Opcode.FOOTER and length < 64:
                return
            known = 0 < code <= Opcode.DATA_END or code >= 0x80
            if not known or end > self._size or length > MAX_RECORD_BYTES:
                self._report_damage(f"the record of {length} bytes at byte {offset} is not valid")
                offset = self._find_next_chunk(stream, offset + 1)
                continue
            if code in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK):
                self._index_record(stream, offset, length)
            offset = end

    def _index_record(self, stream: BinaryIO, offset: int, length: int) -> None:
        """Index a record of the data section."""
        stream.seek(offset)
        try:
            code, data = self._read_record(stream)
            records = _unpack_chunk(code, data) if code == Opcode.CHUNK else [_parse(code, data)]
        except Exception as error:  # damaged records make the libraries raise anything
            self._report_damage(f"the record at byte {offset} cannot be read ({type(error).__name__})")
            self.skipped_bytes += length
            return
        times = []
        for record in records:
            if isinstance(record, Schema):
                self._schemas[record.id] = record
            elif isinstance(record, Channel):
                self.channels[record.id] = record
            elif isinstance(record, Message):
                self.counts[record.channel_id] += 1
                times.append(record.log_time)
        if code == Opcode.CHUNK and times:
            self._chunks.append(_ChunkSpan(min(times), max(times), offset, length))
        elif times:
            self._times.append(times[0])
            self._offsets.append(offset)

    def _report_damage(self, problem: str) -> None:
        if not self._salvage:
            raise InputError(f"{self.path} is damaged: {problem}; add --salvage to read the rest")
        self.damaged += 1

    def _find_next_chunk(self, stream: BinaryIO, start: int) -> int:
        """Return the offset of the next record that looks like a whole compressed chunk, or the file size."""
        offset = start
        while offset < self._size:
            stream.seek(offset)
            piece = stream.read(_SEARCH_BYTES + 16)
            for found in _CHUNK_MARK.finditer(piece):
                head = offset + found.start() - _COMPRESSION_OFFSET
                if head < start:
                    continue
                stream.seek(head)
                code, length = _RECORD_HEADER.unpack(stream.read(_RECORD_HEADER.size))
                if code == Opcode.CHUNK and head + _RECORD_HEADER.size + length <= self._size:
                    self.skipped_bytes += head - start
                    return head
            offset += _SEARCH_BYTES
        self.skipped_bytes += self._size - start
        return self._size

    @staticmethod
    def _read_record(stream: BinaryIO) -> tuple[int, bytes]:
        code, length = _RECORD_HEADER.unpack(stream.read(_RECORD_HEADER.size))
        data = stream.read(length)
        if len(data) < length:
            raise McapError(f"a record of {length} bytes has {len(data)}")
        return code, data


def _parse(code: int, data: bytes) -> McapRecord | None:
    stream = ReadDataStream(io.BytesIO(data))
    if code == Opcode.SCHEMA:
        return Schema.read(stream)
    if code == Opcode.CHANNEL:
        return Channel.read(stream)
    return Message.read(stream, len(data)) if code == Opcode.MESSAGE else None


def _unpack_chunk(code: int, data: bytes) -> list[McapRecord]:
    """Return the records of a chunk; McapError if its checksum or sizes are wrong."""
    chunk = Chunk.read(ReadDataStream(io.BytesIO(data)))
    if chunk.uncompressed_size > MAX_RECORD_BYTES:
        raise McapError(f"a chunk of {chunk.uncompressed_size} bytes is too large")
    return breakup_chunk(chunk, validate_crc=True)
