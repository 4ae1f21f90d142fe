# SPDX-License-Identifier: Apache-2.0
"""Reader of glTF 2.0, .glb or .gltf: the triangles of its scene where its nodes put them (Khronos, glTF 2.0)."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from scipy.spatial.transform import Rotation

from flowing_puppet_ros.errors import InputError

TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
TRIANGLES, STRIP, FAN = 4, 5, 6
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
MAX_DEPTH = 200  # of nodes within nodes

Mesh = tuple[np.ndarray, np.ndarray]


def read_gltf(path: Path) -> Mesh:
    """Read the vertices (N, 3) and triangles (F, 3) of all meshes of the scene; skins and animations do not count.

    Raises:
        InputError: when it is no glTF 2.0, is damaged, compressed, or has no triangles.
    """
    try:
        document, binary = _load(path)
        packed = [name for name in document.get("extensionsRequired", []) if "compression" in name]
        if packed:
            raise InputError(f"{path} needs {packed[0]}, which is not read; export it without compression")
        file = _GltfFile(document, binary, path)
        meshes = [mesh for node in file.list_roots() for mesh in file.collect(node, np.eye(4), 0)]
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, struct.error, OSError) as error:
        raise InputError(f"{path} is no complete glTF 2.0 file; export it again") from error
    if not meshes:
        raise InputError(f"{path} holds no triangles; export the mesh itself")
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    return (
        np.concatenate([vertices for vertices, _ in meshes]),
        np.concatenate([faces + start for (_, faces), start in zip(meshes, starts[:-1], strict=True)]),
    )


def _load(path: Path) -> tuple[dict[str, Any], bytes]:
    """Return the document and the binary chunk, empty without one."""
    data = path.read_bytes()
    if not data.startswith(b"glTF"):
        return json.loads(data.decode("utf-8-sig")), b""
    chunks, at = dict[int, bytes](), 12
    while at + 8 <= len(data):
        length, kind = struct.unpack_from("<II", data, at)
        if at + 8 + length > len(data):
            raise ValueError(length)
        chunks.setdefault(kind, data[at + 8 : at + 8 + length])
        at += 8 + length
    return json.loads(chunks[JSON_CHUNK]), chunks.get(BINARY_CHUNK, b"")


class _GltfFile:
    """A document with its buffers."""

    def __init__(self, document: dict[str, Any], binary: bytes, path: Path) -> None:
        self._document = document
        self._binary = binary
        self._path = path

    def list_roots(self) -> list[int]:
        """Return the nodes of the scene that is shown, or all that are in no other."""
        scenes, nodes = self._document.get("scenes", []), self._document.get("nodes", [])
        if scenes:
            return list(scenes[self._document.get("scene", 0)].get("nodes", []))
        children = {child for node in nodes for child in node.get("children", [])}
        return [number for number in range(len(nodes)) if number not in children]

    def collect(self, number: int, outer: np.ndarray, depth: int) -> list[Mesh]:
        """Return the meshes of a node and of those within it; `outer` (4, 4) places the node."""
        if depth > MAX_DEPTH:
            raise ValueError(depth)
        node = self._document["nodes"][number]
        place = outer @ _read_transform(node)
        meshes = []
        for primitive in self._document["meshes"][node["mesh"]]["primitives"] if "mesh" in node else ():
            vertices = self._read_accessor(primitive["attributes"]["POSITION"])
            rows = self._read_accessor(primitive["indices"])[:, 0] if "indices" in primitive else range(len(vertices))
            faces = _make_triangles(np.asarray(rows, dtype=np.int64), primitive.get("mode", TRIANGLES))
            if len(faces):
                meshes.append((vertices @ place[:3, :3].T + place[:3, 3], faces))
        for child in node.get("children", []):
            meshes += self.collect(child, place, depth + 1)
        return meshes

    def _read_accessor(self, number: int) -> np.ndarray:
        accessor = self._document["accessors"][number]
        view = self._document["bufferViews"][accessor["bufferView"]]
        kind, width, count = TYPES[accessor["componentType"]], WIDTHS[accessor["type"]], int(accessor["count"])
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        step = view.get("byteStride", np.dtype(kind).itemsize * width)
        data = self._read_buffer(view["buffer"])
        row = np.dtype({"names": ["value"], "formats": [(kind, (width,))], "itemsize": step})
        # The last row may end before the stride does.
        padded = data[start : start + step * count].ljust(step * count, b"\0")
        if count < 0 or len(data) < start + step * (count - 1) + np.dtype(kind).itemsize * width:
            raise ValueError(count)
        return np.asarray(np.frombuffer(padded, row, count)["value"], dtype=np.float64)

    def _read_buffer(self, number: int) -> bytes:
        address = self._document["buffers"][number].get("uri")
        if address is None:
            return self._binary
        if address.startswith("data:"):
            return base64.b64decode(address.partition(",")[2])
        beside = self._path.parent / unquote(address)
        if not beside.is_file():
            raise InputError(f"{self._path} names {address}, which is not beside it; keep both together")
        return beside.read_bytes()


def _read_transform(node: dict[str, Any]) -> np.ndarray:
    """Return the matrix (4, 4) of a node; glTF stores it by columns."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    place = np.eye(4)
    turn = Rotation.from_quat(node.get("rotation", [0.0, 0.0, 0.0, 1.0])).as_matrix()
    place[:3, :3] = turn * np.array(node.get("scale", [1.0, 1.0, 1.0]))
    place[:3, 3] = node.get("translation", [0.0, 0.0, 0.0])
    return place


def _make_triangles(rows: np.ndarray, mode: int) -> np.ndarray:
    """Return the triangles (F, 3) of vertices in order; none of points and lines."""
    if mode == TRIANGLES:
        return rows[: len(rows) // 3 * 3].reshape(-1, 3)
    if mode == STRIP:
        strip = np.stack([rows[:-2], rows[1:-1], rows[2:]], axis=1)
        strip[1::2] = strip[1::2, [1, 0, 2]]
        return strip
    if mode == FAN:
        return np.stack([np.full(len(rows) - 2, rows[0]), rows[1:-1], rows[2:]], axis=1)
    return np.empty((0, 3), dtype=np.int64)
