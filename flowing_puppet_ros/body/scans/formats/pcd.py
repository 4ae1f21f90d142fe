# SPDX-License-Identifier: Apache-2.0
"""Reader of .pcd, the files of the Point Cloud Library: text, binary, or binary compressed by columns."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F64, U8
from flowing_puppet_ros.errors import InputError

KINDS = {"F": "f", "I": "i", "U": "u"}
MAX_HEADER_BYTES = 4096
PADDING = "_"
"""Name of a field that only fills up a point."""
DEFAULTS = {"COUNT": "1", "VIEWPOINT": "0 0 0 1 0 0 0", "HEIGHT": "1"}


@dataclass(frozen=True, slots=True, eq=False)
class PcdCloud:
    """The content of a .pcd of N points.

    Attributes:
        points: (N, 3), NaN where the sensor saw nothing.
        normals: (N, 3) or None.
        rgb: (N, 3) or None.
        viewpoint: (3,) position of the sensor; None where the file names none, or the origin.
        shape: (height, width); the height is 1 where the points are in no order.
    """

    points: F64
    normals: F64 | None
    rgb: U8 | None
    viewpoint: F64 | None
    shape: tuple[int, int]


def read_pcd(path: Path) -> PcdCloud:
    """Read a .pcd.

    Raises:
        InputError: when it is none, ends early, or has no fields x, y and z.
    """
    data = path.read_bytes()
    header, start = _parse_header(data, path)
    try:
        fields = _list_fields(header)
        height, width = int(header["HEIGHT"]), int(header["WIDTH"])
        count = int(header.get("POINTS", height * width))
        columns = _read_columns(data[start:], header["DATA"].lower(), fields, count)
    except (KeyError, ValueError, IndexError, struct.error):
        raise InputError(f"{path} ends early or is damaged; export it again and check that it is complete") from None
    if not {"x", "y", "z"} <= set(columns):
        raise InputError(f"{path} has the fields {', '.join(columns)}; x, y and z are needed")
    normals = [columns[name] for name in ("normal_x", "normal_y", "normal_z") if name in columns]
    return PcdCloud(
        np.stack([columns[name] for name in "xyz"], axis=1).astype(np.float64),
        np.stack(normals, axis=1).astype(np.float64) if len(normals) == 3 else None,
        _unpack_rgb(columns.get("rgb", columns.get("rgba"))),
        _parse_viewpoint(header["VIEWPOINT"]),
        (height, width) if height * width == count else (1, count),
    )


def _parse_header(data: bytes, path: Path) -> tuple[dict[str, str], int]:
    """Return the header's lines by their first word, and where the points begin."""
    header, at = dict(DEFAULTS), 0
    while at < min(len(data), MAX_HEADER_BYTES):
        end = data.find(b"\n", at)
        if end < 0:
            break
        words = data[at:end].decode("ascii", errors="replace").strip().split(maxsplit=1)
        at = end + 1
        if len(words) == 2:
            header[words[0]] = words[1]
        if words[:1] == ["DATA"]:
            return header, at
    raise InputError(f"{path} is not a complete .pcd file; export it again")


def _list_fields(header: dict[str, str]) -> list[tuple[str, str, int]]:
    """Return name, NumPy type and count of every field; names that come twice or only fill up become unique."""
    names = header["FIELDS"].split()
    sizes, kinds = header["SIZE"].split(), header["TYPE"].split()
    counts = header["COUNT"].split() if header["COUNT"] != "1" else ["1"] * len(names)
    fields = []
    for number, (name, size, kind, count) in enumerate(zip(names, sizes, kinds, counts, strict=True)):
        unique = f"{name} {number}" if name == PADDING or name in names[:number] else name
        fields.append((unique, f"<{KINDS[kind]}{int(size)}", int(count)))
    return fields


def _read_columns(data: bytes, form: str, fields: list[tuple[str, str, int]], count: int) -> dict[str, np.ndarray]:
    """Return the fields of one number a point; ValueError when there are fewer points."""
    if form == "ascii":
        return _read_text(data, fields, count)
    if form == "binary":
        rows = np.frombuffer(data, np.dtype([(name, kind, (many,)) for name, kind, many in fields]), count)
        return {name: rows[name][:, 0] for name, _, many in fields if many == 1}
    if form != "binary_compressed":
        raise ValueError(form)
    packed, size = struct.unpack_from("<II", data)
    stored = np.frombuffer(data, np.uint8, packed, 8)
    if size != count * sum(np.dtype(kind).itemsize * many for _, kind, many in fields):
        raise ValueError(size)
    unpacked = np.zeros(size, np.uint8)
    if _unpack_lzf(stored, unpacked) != size:
        raise ValueError(size)
    columns, at = {}, 0
    for name, kind, many in fields:
        if many == 1:
            columns[name] = np.frombuffer(unpacked, kind, count, at)
        at += np.dtype(kind).itemsize * many * count
    return columns


def _read_text(data: bytes, fields: list[tuple[str, str, int]], count: int) -> dict[str, np.ndarray]:
    width = sum(many for _, _, many in fields)
    words = data.split()[: count * width]
    table = np.array(words, dtype="S32").reshape(count, width)
    columns, at = {}, 0
    for name, kind, many in fields:
        if many == 1:
            number = table[:, at].astype(np.float64)  # text may have more digits than the type that it names
            columns[name] = number if kind[1] == "f" else number.astype(kind)
        at += many
    return columns


@njit(cache=True, nogil=True)
def _unpack_lzf(stored, unpacked):  # type: ignore[no-untyped-def]
    """Unpack LZF (Marc Lehmann's format) and return the number of bytes, -1 if it is damaged.

    A control byte below 32 announces so many bytes and one more as they are. Otherwise its upper three bits plus two
    (if they are 7, plus a further byte) are the length of a copy, its lower five and the next byte the distance back.
    """
    at, end = 0, 0
    while at < len(stored):
        control = int(stored[at])
        at += 1
        if control < 32:
            length = control + 1
            if at + length > len(stored) or end + length > len(unpacked):
                return -1
            unpacked[end : end + length] = stored[at : at + length]
            at += length
            end += length
            continue
        length = control >> 5
        if length == 7:
            if at >= len(stored):
                return -1
            length += int(stored[at])
            at += 1
        length += 2
        if at >= len(stored):
            return -1
        source = end - ((control & 31) << 8) - int(stored[at]) - 1
        at += 1
        if source < 0 or end + length > len(unpacked):
            return -1
        for k in range(length):  # byte by byte, since a copy may reach into itself
            unpacked[end + k] = unpacked[source + k]
        end += length
    return end


def _unpack_rgb(packed: np.ndarray | None) -> U8 | None:
    """Return colours (N, 3) from the bits of floats or whole numbers, blue in the lowest byte."""
    if packed is None:
        return None
    kind = np.float32 if packed.dtype.kind == "f" else np.uint32
    bits = np.ascontiguousarray(packed.astype(kind)).view(np.uint32)
    return np.stack([bits >> 16 & 255, bits >> 8 & 255, bits & 255], axis=1).astype(np.uint8)


def _parse_viewpoint(text: str) -> F64 | None:
    """Return the translation (3,) of the line VIEWPOINT; None where it is damaged, or the origin."""
    try:
        place = np.array([float(word) for word in text.split()[:3]])
    except ValueError:
        return None
    return place if len(place) == 3 and np.isfinite(place).all() and place.any() else None
