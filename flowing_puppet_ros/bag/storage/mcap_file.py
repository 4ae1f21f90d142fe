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
import zlib
from array import array
from collections import Counter
from collections.abc import Collection, Container, Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import breakup_chunk, get_chunk_data_stream

from flowing_puppet_ros.bag.storage.compression import decompress_prefix
from flowing_puppet_ros.bag.storage.stored_file import ChunkSpan, StoredTopic, merge_chunks, parse_qos
from flowing_puppet_ros.errors import InputError

MAGIC = b"\x89MCAP0\r\n"
MAX_RECORD_BYTES = 1 << 30
"""Maximum size of a record or chunk."""
MESSAGE_ENCODINGS = ("cdr", "ros1", "json", "protobuf")
"""Encodings of messages that are passed on; others, and messages without a schema, are left out."""
_RECORD_HEADER = struct.Struct("<BQ")
_COMPRESSION_OFFSET = _RECORD_HEADER.size + 8 + 8 + 8 + 4
"""Bytes of a chunk record before the name of its compression."""
_CHUNK_HEAD = struct.Struct("<QQQII")
"""Times of the first and last message, size, checksum, length of the name of the compression."""
_MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence number, times at which a message was logged and published."""
_CHUNK_MARK = re.compile(rb"\x04\x00\x00\x00zstd|\x03\x00\x00\x00lz4")
_SEARCH_BYTES = 1 << 20
"""Bytes that are searched at a time for the next chunk."""


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
        topics: only those whose messages have an encoding that somebody here reads, and a named type.
        notes: with `salvage`, how many messages were read and what was passed over.
        damaged: chunks and records that could not be read.
        skipped_bytes: bytes that were skipped because of damage.
    """

    def __init__(self, path: Path, salvage: bool = False) -> None:
        """Scan the file. Damage is skipped with `salvage`, otherwise it is an InputError."""
        self.path = path
        self.notes: list[str] = []
        self.damaged = 0
        self.skipped_bytes = 0
        self._salvage = salvage
        self._channels: dict[int, Channel] = {}
        self._counts: Counter[int] = Counter()
        self._schemas: dict[int, Schema] = {}
        self._chunks: list[ChunkSpan] = []
        # Log times and offsets of the messages outside of chunks.
        self._times, self._offsets = array("Q"), array("Q")
        self._of_cut_chunk = 0
        self._size = path.stat().st_size
        with path.open("rb") as stream:
            self._scan(stream)
        self._numbers = sorted(number for number, channel in self._channels.items() if self._is_usable(channel))
        self.topics = [self._describe_topic(number) for number in self._numbers]
        if salvage:
            self.notes.append(self._describe_salvage())

    def messages(self, chosen: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        """Yield (index in `topics`, log time, bytes) of the messages of some topics in the order of log times."""
        indices = {self._numbers[index]: index for index in chosen}
        with self.path.open("rb") as loose, self.path.open("rb") as chunked:
            chunks = merge_chunks(self._chunks, lambda chunk: self._read_chunk(chunked, chunk, indices))
            yield from heapq.merge(self._read_loose(loose, indices), chunks, key=lambda item: item[1])

    def close(self) -> None:
        """Do nothing: it is open only while it is read."""

    def _describe_topic(self, number: int) -> StoredTopic:
        channel = self._channels[number]
        schema = self._schemas[channel.schema_id]
        qos = parse_qos(channel.metadata.get("offered_qos_profiles", ""))
        return StoredTopic(
            channel.topic,
            schema.name,
            channel.message_encoding,
            schema.encoding,
            schema.data,
            self._counts[number],
            qos,
        )

    def _describe_salvage(self) -> str:
        note = f"{self.path}: {sum(topic.count for topic in self.topics)} messages salvaged"
        if self._of_cut_chunk:
            note += f", {self._of_cut_chunk} of them from a chunk that is cut off, whose checksum is lost"
        if self.damaged:
            note += f", {self.damaged} damaged places ({self.skipped_bytes} bytes) passed over"
        return note

    def _is_usable(self, channel: Channel) -> bool:
        return channel.message_encoding in MESSAGE_ENCODINGS and channel.schema_id in self._schemas

    def _read_loose(self, stream: BinaryIO, indices: Mapping[int, int]) -> Iterator[tuple[int, int, bytes]]:
        for place in sorted(range(len(self._times)), key=self._times.__getitem__):
            stream.seek(self._offsets[place])
            message = _parse(*self._read_record(stream))
            if isinstance(message, Message) and message.channel_id in indices:
                yield indices[message.channel_id], message.log_time, message.data

    def _read_chunk(
        self, stream: BinaryIO, chunk: ChunkSpan, indices: Mapping[int, int]
    ) -> Iterator[tuple[int, int, bytes]]:
        stream.seek(chunk.offset)
        if not chunk.cut:
            for number, time, data in _unpack_messages(self._read_record(stream)[1], indices):
                yield indices[number], time, data
            return
        for message in _unpack_cut_chunk(stream.read(_RECORD_HEADER.size + chunk.length)[_RECORD_HEADER.size :]):
            if isinstance(message, Message) and message.channel_id in indices:
                yield indices[message.channel_id], message.log_time, message.data

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
                next_chunk = self._find_next_chunk(stream, offset + 1)
                if code == Opcode.CHUNK and next_chunk == self._size:
                    self._index_cut_chunk(stream, offset)
                offset = next_chunk
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
        times = self._note_records(records)
        if code == Opcode.CHUNK and times:
            self._chunks.append(ChunkSpan(min(times), max(times), offset, length))
        elif times:
            self._times.append(times[0])
            self._offsets.append(offset)

    def _index_cut_chunk(self, stream: BinaryIO, offset: int) -> None:
        """Index the whole messages at the beginning of a chunk after which the file ends."""
        stream.seek(offset + _RECORD_HEADER.size)
        data = stream.read(MAX_RECORD_BYTES)
        times = self._note_records(_unpack_cut_chunk(data))
        if times:
            self._chunks.append(ChunkSpan(min(times), max(times), offset, len(data), cut=True))
            self._of_cut_chunk = len(times)
            self.damaged -= 1
            self.skipped_bytes -= max(0, self._size - offset - 1)

    def _note_records(self, records: Iterable[McapRecord | None]) -> list[int]:
        """Keep schemas and channels, count messages and return their log times."""
        times = []
        for record in records:
            if isinstance(record, Schema):
                self._schemas[record.id] = record
            elif isinstance(record, Channel):
                self._channels[record.id] = record
            elif isinstance(record, Message):
                self._counts[record.channel_id] += 1
                times.append(record.log_time)
        return times

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


def _unpack_messages(data: bytes, channels: Container[int]) -> Iterator[tuple[int, int, bytes]]:
    """Yield (channel, log time, bytes) of some channels' messages in a chunk that `_unpack_chunk` has once passed.

    Whoever wants a few topics reads all chunks, and most messages are passed over without making a record of each.
    """
    stream, length = get_chunk_data_stream(Chunk.read(ReadDataStream(io.BytesIO(data))))
    unpacked, place = stream.read(length), 0
    while place < length:
        code, size = _RECORD_HEADER.unpack_from(unpacked, place)
        start = place + _RECORD_HEADER.size
        place = start + size
        if code == Opcode.MESSAGE:
            number, _, time, _ = _MESSAGE_HEAD.unpack_from(unpacked, start)
            if number in channels:
                yield number, time, unpacked[start + _MESSAGE_HEAD.size : place]


def _unpack_cut_chunk(data: bytes) -> list[McapRecord]:
    """Return the whole records at the beginning of a chunk that ends too early.

    Nothing vouches for them unless all are there, so they have to be what a chunk may contain, with log times in the
    range of the chunk.
    """
    if len(data) < _CHUNK_HEAD.size:
        return []
    first, last, size, checksum, length = _CHUNK_HEAD.unpack_from(data)
    (name, start) = (data[_CHUNK_HEAD.size : _CHUNK_HEAD.size + length], _CHUNK_HEAD.size + length + 8)
    if name not in (b"", b"zstd", b"lz4") or size > MAX_RECORD_BYTES or len(data) <= start:
        return []
    unpacked, found, offset = decompress_prefix(name.decode(), data[start:])[:size], list[McapRecord](), 0
    if len(unpacked) == size and checksum and zlib.crc32(unpacked) != checksum:
        return []
    while offset + _RECORD_HEADER.size <= len(unpacked):
        code, length = _RECORD_HEADER.unpack_from(unpacked, offset)
        offset, end = offset + _RECORD_HEADER.size, offset + _RECORD_HEADER.size + length
        if code not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE) or end > len(unpacked):
            break
        try:
            record = _parse(code, unpacked[offset:end])
        except Exception:  # as with damaged records
            break
        if isinstance(record, Message) and not first <= record.log_time <= last:
            break
        if record is not None:
            found.append(record)
        offset = end
    return found
