# SPDX-License-Identifier: Apache-2.0
"""One MCAP file read without its index: whatever a writer left out, cut off or damaged, the rest is read in log order.

A scan notes where chunks and loose messages stand and when they were recorded. Reading then has in memory only the
chunks whose times overlap.
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
LARGEST = 1 << 30
"""Bytes of the largest record or chunk that is read."""
_HEAD = struct.Struct("<BQ")
_BEFORE_COMPRESSION = _HEAD.size + 8 + 8 + 8 + 4
"""Bytes of a chunk record before the name of its compression."""
_CHUNK_MARK = re.compile(rb"\x04\x00\x00\x00zstd|\x03\x00\x00\x00lz4")
_SEARCHED = 1 << 20
"""Bytes that are searched for a chunk at a time."""


@dataclass(frozen=True, slots=True)
class _Block:
    """A chunk: the log times of its first and last message, where it stands, and its length with its head."""

    first: int
    last: int
    offset: int
    length: int


def is_mcap(path: Path) -> bool:
    """Whether `path` starts as an MCAP file does."""
    with path.open("rb") as stream:
        return stream.read(len(MAGIC)) == MAGIC


def is_truncated(path: Path) -> bool:
    """Whether `path` starts as an MCAP file does and does not end as one does."""
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
        channels: by number; only those whose messages are CDR of a named type.
        types: type of each of them, by number.
        counts: messages of each of them, by number.
        damaged: chunks and records that could not be read, and bytes that were skipped because of that.
    """

    def __init__(self, path: Path, salvage: bool = False) -> None:
        """Scan the file. With `salvage` what is damaged is passed over, else it is an InputError."""
        self.path = path
        self.channels: dict[int, Channel] = {}
        self.counts: Counter[int] = Counter()
        self.damaged = 0
        self.skipped_bytes = 0
        self._salvage = salvage
        self._schemas: dict[int, Schema] = {}
        self._blocks: list[_Block] = []
        # Times and places of the messages outside of chunks.
        self._times, self._places = array("Q"), array("Q")
        self._size = path.stat().st_size
        with path.open("rb") as stream:
            self._scan(stream)
        usable = {number for number, channel in self.channels.items() if self._usable(channel)}
        self.channels = {number: self.channels[number] for number in sorted(usable)}
        self.types = {number: self._schemas[channel.schema_id].name for number, channel in self.channels.items()}

    def messages(self, numbers: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        """Yield (channel number, log time, bytes) of the messages of some channels in the order of log times."""
        chosen = set(numbers)
        with self.path.open("rb") as loose, self.path.open("rb") as chunked:
            yield from heapq.merge(self._loose(loose, chosen), self._chunked(chunked, chosen), key=lambda item: item[1])

    def _usable(self, channel: Channel) -> bool:
        return channel.message_encoding == "cdr" and channel.schema_id in self._schemas

    def _loose(self, stream: BinaryIO, chosen: set[int]) -> Iterator[tuple[int, int, bytes]]:
        for index in sorted(range(len(self._times)), key=self._times.__getitem__):
            stream.seek(self._places[index])
            message = _parsed(*self._record(stream))
            if isinstance(message, Message) and message.channel_id in chosen:
                yield message.channel_id, message.log_time, message.data

    def _chunked(self, stream: BinaryIO, chosen: set[int]) -> Iterator[tuple[int, int, bytes]]:
        waiting: list[tuple[int, int, int, bytes]] = []
        order = 0
        for block in sorted(self._blocks, key=lambda block: (block.first, block.offset)):
            while waiting and waiting[0][0] < block.first:
                time, _, number, data = heapq.heappop(waiting)
                yield number, time, data
            stream.seek(block.offset)
            for message in _inside(*self._record(stream)):
                if isinstance(message, Message) and message.channel_id in chosen:
                    heapq.heappush(waiting, (message.log_time, order, message.channel_id, message.data))
                    order += 1
        while waiting:
            time, _, number, data = heapq.heappop(waiting)
            yield number, time, data

    def _scan(self, stream: BinaryIO) -> None:
        place = len(MAGIC)
        while place + _HEAD.size <= self._size - len(MAGIC) or (self._salvage and place + _HEAD.size <= self._size):
            stream.seek(place)
            code, length = _HEAD.unpack(stream.read(_HEAD.size))
            end = place + _HEAD.size + length
            if code == Opcode.FOOTER and length < 64:
                return
            known = 0 < code <= Opcode.DATA_END or code >= 0x80
            if not known or end > self._size or length > LARGEST:
                self._lost(f"a record of {length} bytes at byte {place} is none")
                place = self._next_chunk(stream, place + 1)
                continue
            if code in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK):
                self._note(stream, place, length)
            place = end

    def _note(self, stream: BinaryIO, place: int, length: int) -> None:
        """Take in a record of the data section."""
        stream.seek(place)
        try:
            code, data = self._record(stream)
            records = _inside(code, data) if code == Opcode.CHUNK else [_parsed(code, data)]
        except Exception as error:  # damaged records fail in the libraries in any way
            self._lost(f"the record at byte {place} cannot be read ({type(error).__name__})")
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
            self._blocks.append(_Block(min(times), max(times), place, length))
        elif times:
            self._times.append(times[0])
            self._places.append(place)

    def _lost(self, what: str) -> None:
        if not self._salvage:
            raise InputError(f"{self.path} is damaged: {what}; add --salvage to read the rest")
        self.damaged += 1

    def _next_chunk(self, stream: BinaryIO, place: int) -> int:
        """Where the next record stands that looks like a whole compressed chunk; the end of the file when none does."""
        start = place
        while place < self._size:
            stream.seek(place)
            piece = stream.read(_SEARCHED + 16)
            for found in _CHUNK_MARK.finditer(piece):
                head = place + found.start() - _BEFORE_COMPRESSION
                if head < start:
                    continue
                stream.seek(head)
                code, length = _HEAD.unpack(stream.read(_HEAD.size))
                if code == Opcode.CHUNK and head + _HEAD.size + length <= self._size:
                    self.skipped_bytes += head - start
                    return head
            place += _SEARCHED
        self.skipped_bytes += self._size - start
        return self._size

    @staticmethod
    def _record(stream: BinaryIO) -> tuple[int, bytes]:
        code, length = _HEAD.unpack(stream.read(_HEAD.size))
        data = stream.read(length)
        if len(data) < length:
            raise McapError(f"a record of {length} bytes has {len(data)}")
        return code, data


def _parsed(code: int, data: bytes) -> McapRecord | None:
    stream = ReadDataStream(io.BytesIO(data))
    if code == Opcode.SCHEMA:
        return Schema.read(stream)
    if code == Opcode.CHANNEL:
        return Channel.read(stream)
    return Message.read(stream, len(data)) if code == Opcode.MESSAGE else None


def _inside(code: int, data: bytes) -> list[McapRecord]:
    """The records of a chunk whose sum and sizes are right."""
    chunk = Chunk.read(ReadDataStream(io.BytesIO(data)))
    if chunk.uncompressed_size > LARGEST:
        raise McapError(f"a chunk of {chunk.uncompressed_size} bytes is too large")
    return breakup_chunk(chunk, validate_crc=True)
