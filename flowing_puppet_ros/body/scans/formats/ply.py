# SPDX-License-Identifier: Apache-2.0
"""Reader of .ply, text or binary, little- or big-endian: vertices, normals and polygons in the file's order.

It is our own because damaged and hostile (fuzzed) files must end in an `InputError`, never in a crash.
"""

from __future__ import annotations

import codecs
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from flowing_puppet_ros.body.cloud.mesh_geometry import triangulate_fans
from flowing_puppet_ros.errors import InputError

# NumPy types by the format's names of types, and byte orders by its names of formats.
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
POLYGON_NAMES = ("vertex_indices", "vertex_index")


@dataclass(frozen=True, slots=True)
class Property:
    """A column of an element; `count` is the type of a list's length, empty for a plain number."""

    name: str
    kind: str
    count: str = ""


@dataclass(slots=True)
class Element:
    """A table of the file."""

    name: str
    rows: int
    properties: list[Property]


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
    """Read vertices (N, 3) float64, their normals (N, 3) or None, and triangles (F, 3); polygons become fans.

    Raises:
        InputError: when it is not a .ply file, ends early, or has no vertices with x, y and z.
    """
    data = path.read_bytes().removeprefix(codecs.BOM_UTF8)
    if data.startswith((b"ply\rformat ascii", b"ply\rcomment")):  # lines end as they did on old Macs
        data = data.replace(b"\r", b"\n")
    end = data.find(b"end_header")
    start = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or not start:
        raise InputError(f"{path} is not a complete .ply file; export it again")
    order, elements = _parse_header(data[:end].decode("ascii", errors="replace"), path)
    try:
        tables = _parse_text(data[start:], elements) if not order else _parse_binary(data[start:], elements, order)
    except (ValueError, IndexError, OverflowError):
        raise InputError(f"{path} ends early or is damaged; export it again and check that it is complete") from None
    vertex = tables.get("vertex", {})
    if not all(name in vertex for name in "xyz"):
        raise InputError(f"{path} holds no vertices with x, y and z; export it again")
    points = np.stack([vertex[name] for name in "xyz"], axis=1).astype(np.float64)
    normals = None
    if all(name in vertex for name in ("nx", "ny", "nz")):
        normals = np.stack([vertex[name] for name in ("nx", "ny", "nz")], axis=1).astype(np.float64)
    if tables.get("tristrips"):
        raise InputError(f"{path} has strips instead of faces; export it again with triangles")
    faces = next((tables["face"][name] for name in POLYGON_NAMES if name in tables.get("face", {})), np.empty((0, 3)))
    return points, normals, np.asarray(faces, dtype=np.int64)


def _parse_header(text: str, path: Path) -> tuple[str, list[Element]]:
    """Return the byte order, empty for text, and the elements."""
    order, elements = "", list[Element]()
    try:
        for words in (line.split() for line in text.splitlines()):
            if words[:1] == ["format"]:
                order = FORMATS[words[1]]
            elif words[:1] == ["element"]:
                elements.append(Element(words[1], _check_count(int(words[2])), []))
            elif words[:2] == ["property", "list"]:
                elements[-1].properties.append(Property(words[4], TYPES[words[3]], TYPES[words[2]]))
            elif words[:1] == ["property"]:
                elements[-1].properties.append(Property(words[2], TYPES[words[1]]))
    except (KeyError, IndexError, ValueError):
        raise InputError(f"{path} has a header that cannot be read; export it again") from None
    return order, elements


def _parse_text(data: bytes, elements: list[Element]) -> dict[str, dict[str, np.ndarray]]:
    words = iter(data.split())
    tables = {}
    for element in elements:
        if not any(column.count for column in element.properties):
            width = len(element.properties)
            values = np.array(list(islice(words, element.rows * width)), dtype=np.float64).reshape(element.rows, width)
            tables[element.name] = {column.name: values[:, k] for k, column in enumerate(element.properties)}
            continue
        rows: dict[str, list[list[float]]] = {column.name: [] for column in element.properties}
        for _ in range(element.rows):
            for column in element.properties:
                length = _check_count(float(next(words, b"missing"))) if column.count else 1
                row = [float(word) for word in islice(words, length)]
                if len(row) < length:
                    raise ValueError(length)
                rows[column.name].append(row)
        tables[element.name] = _gather_columns(element, rows)
    return tables


def _check_count(length: float) -> int:
    if length < 0:
        raise ValueError(length)
    return int(length)


def _parse_binary(data: bytes, elements: list[Element], order: str) -> dict[str, dict[str, np.ndarray]]:
    tables, at = {}, 0
    for element in elements:
        lengths = _read_first_lengths(data, at, element, order)
        kind = np.dtype([field for column, length in lengths for field in _list_fields(column, length, order)])
        if at + element.rows * kind.itemsize <= len(data):
            table = np.frombuffer(data, kind, element.rows, at)
            if all((table[f"count {column.name}"] == length).all() for column, length in lengths if column.count):
                at += element.rows * kind.itemsize
                tables[element.name] = {
                    column.name: _triangulate_equal_fans(table[column.name]) if column.count else table[column.name]
                    for column, length in lengths
                    if length
                }
                continue
        tables[element.name], at = _parse_uneven(data, at, element, order)
    return tables


def _read_first_lengths(data: bytes, at: int, element: Element, order: str) -> list[tuple[Property, int]]:
    """Return every column with the length of its first row: nearly all files have triangles only."""
    lengths = []
    for column in element.properties:
        length = 1
        if column.count:
            length = _check_count(np.frombuffer(data, order + column.count, 1, at)[0]) if element.rows else 0
            at += np.dtype(column.count).itemsize
        at += length * np.dtype(column.kind).itemsize
        lengths.append((column, length))
    return lengths


def _list_fields(column: Property, length: int, order: str) -> list[tuple[str, str] | tuple[str, str, tuple[int]]]:
    if not column.count:
        return [(column.name, order + column.kind)]
    return [(f"count {column.name}", order + column.count), (column.name, order + column.kind, (length,))]


def _parse_uneven(data: bytes, at: int, element: Element, order: str) -> tuple[dict[str, np.ndarray], int]:
    """Read an element whose lists differ in length, row by row; return its columns and where it ends."""
    rows: dict[str, list[list[float]]] = {column.name: [] for column in element.properties}
    for _ in range(element.rows):
        for column in element.properties:
            length = 1
            if column.count:
                length = _check_count(np.frombuffer(data, order + column.count, 1, at)[0])
                at += np.dtype(column.count).itemsize
            row = np.frombuffer(data, order + column.kind, length, at)
            at += row.nbytes
            rows[column.name].append(row.tolist())
    return _gather_columns(element, rows), at


def _gather_columns(element: Element, rows: dict[str, list[list[float]]]) -> dict[str, np.ndarray]:
    """Return the plain numbers (N,) of each column, and the triangles of polygons; other lists are passed over."""
    tables = {}
    for column in element.properties:
        values = rows[column.name]
        if not column.count:
            tables[column.name] = np.array(values, dtype=np.float64).reshape(-1)
        elif column.name in POLYGON_NAMES:
            tables[column.name] = triangulate_fans([[int(value) for value in row] for row in values])
    return tables


def _triangulate_equal_fans(polygons: np.ndarray) -> np.ndarray:
    """Return the triangles (T, 3) of polygons (F, K) that all have K corners."""
    corners = polygons.shape[1]
    fans = [polygons[:, [0, k, k + 1]] for k in range(1, corners - 1)]
    return np.stack(fans, axis=1).reshape(-1, 3) if fans else np.empty((0, 3), dtype=np.int64)
