# SPDX-License-Identifier: Apache-2.0
"""Read what is whole of an MCAP file whose end is missing (a crash or a full disk while recording)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader


def salvaged_records(stream: BinaryIO) -> Iterator[Schema | Channel | Message]:
    """Yield schemas, channels and messages in the order of the file until it ends or stops making sense.

    One chunk at a time is in memory. Messages of a cut chunk are lost.
    """
    try:
        for record in StreamReader(stream, record_size_limit=1 << 30).records:
            if isinstance(record, Schema | Channel | Message):
                yield record
    except Exception:  # cut or damaged records fail in the libraries in any way; what came before them is whole
        return


def is_truncated(path: Path) -> bool:
    """Whether `path` starts as an MCAP file does and does not end as one does."""
    magic = b"\x89MCAP0\r\n"
    with path.open("rb") as stream:
        if stream.read(len(magic)) != magic:
            return False
        stream.seek(0, 2)
        if stream.tell() < 2 * len(magic):
            return True
        stream.seek(-len(magic), 2)
        return stream.read() != magic
