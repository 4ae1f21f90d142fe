# SPDX-License-Identifier: Apache-2.0
"""Compressed files, chunks and messages, also those that end too early."""

from __future__ import annotations

import bz2
import lzma
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame
import zstandard

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_DECOMPRESSORS: dict[str, Callable[[], Any]] = {
    "zstd": lambda: zstandard.ZstdDecompressor().decompressobj(),
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "gzip": lambda: zlib.decompressobj(wbits=31),
    "bz2": bz2.BZ2Decompressor,
    "xz": lzma.LZMADecompressor,
}
_MAGIC = {
    ZSTD_MAGIC: "zstd",
    b"\x04\x22\x4d\x18": "lz4",
    b"\x1f\x8b": "gzip",
    b"BZh": "bz2",
    b"\xfd7zXZ\x00": "xz",
}
_PIECE_BYTES = 1 << 20
_ERRORS = (zstandard.ZstdError, lzma.LZMAError, zlib.error, OSError, EOFError, ValueError, RuntimeError)
"""What the decompressors raise on damaged data."""


def find_compression(start: bytes) -> str:
    """Return how a file that starts with these bytes is compressed; empty if it is not."""
    return next((name for magic, name in _MAGIC.items() if start.startswith(magic)), "")


def decompress_message(data: bytes) -> bytes:
    """Return a message that rosbag2 compressed by itself; InputError is the caller's business, ValueError is raised."""
    decompressor = _DECOMPRESSORS["zstd"]()
    try:
        found = bytes(decompressor.decompress(data))
    except _ERRORS as error:
        raise ValueError(str(error)) from error
    if not decompressor.eof:
        raise ValueError("its zstd data ends too early")
    return found


def decompress_prefix(name: str, data: bytes) -> bytes:
    """Return what can be had of compressed data that may end too early; data without compression as it is."""
    if name in ("", "none"):
        return data
    decompressor, found = _DECOMPRESSORS[name](), bytearray()
    for start in range(0, len(data), _PIECE_BYTES):
        try:
            found += decompressor.decompress(data[start : start + _PIECE_BYTES])
        except _ERRORS:
            break
        if decompressor.eof:
            break
    return bytes(found)


def unpack_file(source: Path, name: str, target: Path) -> bool:
    """Decompress a file, which may have several frames; return whether it was whole. Errors of the disk are raised."""
    decompressor, rest = None, b""
    with source.open("rb") as packed, target.open("wb") as unpacked:
        while True:
            piece = rest or packed.read(_PIECE_BYTES)
            rest = b""
            if not piece:
                return decompressor is None
            if decompressor is None and not piece.strip(b"\0"):
                continue  # padding
            decompressor = decompressor or _DECOMPRESSORS[name]()
            try:
                data = decompressor.decompress(piece)
            except _ERRORS:
                return False
            unpacked.write(data)
            if decompressor.eof:
                rest, decompressor = decompressor.unused_data or b"", None
