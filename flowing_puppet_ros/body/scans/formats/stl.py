# SPDX-License-Identifier: Apache-2.0
"""Reader of .stl, text or binary: the corners of triangles, of which equal ones become one vertex."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np

from flowing_puppet_ros.errors import InputError

HEADER_BYTES = 80
TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
VERTEX = re.compile(rb"^\s*vertex\s+(\S+)\s+(\S+)\s+(\S+)\s*$", re.IGNORECASE | re.MULTILINE)


def read_stl(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read vertices (N, 3), in the order in which they come first, and triangles (F, 3).

    Raises:
        InputError: when it is neither kind of .stl, or ends early.
    """
    data = path.read_bytes()
    try:
        corners = _read_binary(data) if _is_binary(data) else _read_text(data)
    except (ValueError, struct.error):
        raise InputError(f"{path} ends early or is damaged; export it again and check that it is complete") from None
    _, first, which = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return corners[first[order]], rank[np.ravel(which)].reshape(-1, 3)


def _is_binary(data: bytes) -> bool:
    """Return whether the size is that of so many triangles; the word at the beginning says nothing."""
    if len(data) >= HEADER_BYTES + 4:
        count = struct.unpack_from("<I", data, HEADER_BYTES)[0]
        if len(data) == HEADER_BYTES + 4 + count * TRIANGLE.itemsize:
            return True
    return data.lstrip()[:5].lower() != b"solid"


def _read_binary(data: bytes) -> np.ndarray:
    count = struct.unpack_from("<I", data, HEADER_BYTES)[0]
    table = np.frombuffer(data, TRIANGLE, count, HEADER_BYTES + 4)
    return np.asarray(table["corners"].reshape(-1, 3), dtype=np.float64)


def _read_text(data: bytes) -> np.ndarray:
    text = data.replace(b"\r", b"\n")
    corners = np.array(VERTEX.findall(text), dtype="S40").astype(np.float64).reshape(-1, 3)
    if not len(corners) or len(corners) % 3 or b"endsolid" not in text.lower():
        raise ValueError(len(corners))
    return corners
