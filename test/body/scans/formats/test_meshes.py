# SPDX-License-Identifier: Apache-2.0
"""Meshes as other programs write them: .stl, glTF, and the odd corners of .obj, .off and .ply."""

import base64
import json
import struct
from pathlib import Path

import numpy as np
import pytest

from flowing_puppet_ros.body.scans.scan import Scan, read_scan
from flowing_puppet_ros.errors import InputError

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], dtype=float)
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
VOLUME = 1.0  # 1 * 2 * 3 / 6


def volume(scan: Scan) -> float:
    assert scan.faces is not None
    a, b, c = (scan.points[scan.faces[:, k]] for k in range(3))
    return float((np.cross(a, b) * c).sum() / 6)


def binary_stl(head: bytes) -> bytes:
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *CORNERS[face].ravel(), 0) for face in FACES)
    return head.ljust(80) + struct.pack("<I", len(FACES)) + rows


def text_stl() -> str:
    lines = ["solid a"]
    for face in FACES:
        lines += ["facet normal 0 0 0", "outer loop", *("vertex {} {} {}".format(*CORNERS[k]) for k in face)]
        lines += ["endloop", "endfacet"]
    return "\n".join([*lines, "endsolid a", ""])


STLS = {
    "binary": binary_stl(b"from a program"),
    "binary that begins as text does": binary_stl(b"solid from a program"),
    "text": text_stl().encode(),
    "shouting, windows": text_stl().upper().replace("\n", "\r\n").encode(),
}


@pytest.mark.parametrize("kind", STLS)
def test_corners_of_stl_triangles_become_shared_vertices(tmp_path: Path, kind: str) -> None:
    (tmp_path / "a.STL").write_bytes(STLS[kind])
    scan = read_scan(tmp_path / "a.STL")
    np.testing.assert_array_equal(scan.points, CORNERS[[0, 2, 1, 3]])
    assert volume(scan) == pytest.approx(VOLUME)
    (tmp_path / "cut.stl").write_bytes(STLS[kind][:-60])
    with pytest.raises(InputError, match="ends early or is damaged"):
        read_scan(tmp_path / "cut.stl")


def gltf(node: dict, corners: np.ndarray = FACES, mode: int = 4) -> tuple[dict, bytes]:
    """Describe the tetrahedron, its positions interleaved with normals, in a node within a node."""
    indices = corners.ravel()
    rows = np.hstack([CORNERS, np.tile([0.0, 0.0, 1.0], (4, 1))]).astype("<f4").tobytes()
    data = rows + indices.astype("<u2").tobytes()
    views = [{"buffer": 0, "byteLength": len(rows), "byteStride": 24}, {"buffer": 0, "byteOffset": len(rows)}]
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
        {"bufferView": 1, "componentType": 5123, "count": len(indices), "type": "SCALAR"},
    ]
    primitive = {"attributes": {"POSITION": 0}, "indices": 1, "mode": mode}
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [1]}],
        "nodes": [{"mesh": 0, "translation": [0, 0, 5]}, node | {"children": [0]}],
        "meshes": [{"primitives": [primitive]}],
        "bufferViews": views,
        "accessors": accessors,
        "buffers": [{"byteLength": len(data)}],
    }, data


def glb(document: dict, data: bytes) -> bytes:
    text, data = json.dumps(document).encode(), data + bytes(-len(data) % 4)
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body


HALF_TURN = {"rotation": [0, 0, 1, 0], "scale": [2, 2, 2]}  # about z
PLACED = 2 * (CORNERS + np.array([0, 0, 5])) * [-1, -1, 1]


def test_gltf_puts_meshes_where_its_nodes_say(tmp_path: Path) -> None:
    document, data = gltf(HALF_TURN)
    (tmp_path / "a.glb").write_bytes(glb(document, data))
    document["buffers"][0]["uri"] = "a b.bin"
    (tmp_path / "b.gltf").write_text(json.dumps(document | {"buffers": [{"uri": "a%20b.bin"}]}))
    (tmp_path / "a b.bin").write_bytes(data)
    inside = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    (tmp_path / "c.gltf").write_text(json.dumps(document | {"buffers": [{"uri": inside}]}))
    document, data = gltf({"matrix": [-2, 0, 0, 0, 0, -2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1]})
    (tmp_path / "d.glb").write_bytes(glb(document, data))
    # A strip of a tetrahedron: 0 2 1, 2 1 3 turned over, 1 3 0, 3 0 2 turned over.
    document, data = gltf(HALF_TURN, np.array([0, 2, 1, 3, 0, 2]), mode=5)
    (tmp_path / "e.glb").write_bytes(glb(document, data))
    for name in ("a.glb", "b.gltf", "c.gltf", "d.glb", "e.glb"):
        scan = read_scan(tmp_path / name)
        np.testing.assert_allclose(scan.points, PLACED, atol=1e-6, err_msg=name)
        assert volume(scan) == pytest.approx(8 * VOLUME), name


def test_gltf_that_cannot_be_used_is_refused(tmp_path: Path) -> None:
    document, data = gltf(HALF_TURN)
    files = {
        "cut.glb": (glb(document, data)[:-30], "no complete glTF"),
        "text.glb": (b"hello", "no complete glTF"),
        "alone.gltf": (json.dumps(document | {"buffers": [{"uri": "b.bin"}]}).encode(), "keep both together"),
        "points.glb": (glb(gltf(HALF_TURN, mode=0)[0], data), "no triangles"),
        "packed.glb": (glb(document | {"extensionsRequired": ["KHR_draco_mesh_compression"]}, data), "without compr"),
    }
    for name, (content, sentence) in files.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=sentence):
            read_scan(tmp_path / name)


OBJ = ["v 0 0 0 # first", *("v {} {} {} 1.0".format(*corner) for corner in CORNERS[1:])]
OBJ += [f"f {a + 1}//1\t{b + 1}//1 {c + 1}//1 # face" for a, b, c in FACES]
OFF = [*("{} {} {}".format(*corner) for corner in CORNERS), *(f"3 {a} {b} {c}" for a, b, c in FACES)]
PLY = ["ply", "format ascii 1.0", "element vertex 4", *(f"property float {name}" for name in "xyz")]
PLY += ["element face 4", "property list uchar int vertex_index", "end_header", *OFF, ""]
TEXTS = {
    "comments after vertices.obj": "\n".join(OBJ),
    "counts beside the word.off": "\n".join(["OFF 4 4 0", *OFF]),
    "counts touch the word.off": "\n".join(["OFF4 4 0", *OFF]),
    "old Macs.ply": "\r".join(PLY),
}


@pytest.mark.parametrize("name", TEXTS)
def test_odd_texts_are_read(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(TEXTS[name], newline="")
    scan = read_scan(tmp_path / name)
    np.testing.assert_array_equal(scan.points, CORNERS)
    assert volume(scan) == pytest.approx(VOLUME)


REFUSED = {
    "strips.ply": (
        "\n".join([*PLY[:6], "element tristrips 1", "property list int int vertex_indices", "end_header", *OFF[:4],
                   "5 0 2 1 3 -1", ""]),
        "strips instead of faces; export it again with triangles",
    ),
    "a.ply": ("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "git lfs pull"),
    "a.ply.gz": ("x", "unpack it first: gunzip -k"),
    "a.fbx": ("x", "ends in .fbx.* convert it first"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_read_is_told_with_the_way_out(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(REFUSED[name][0])
    with pytest.raises(InputError, match=REFUSED[name][1]):
        read_scan(tmp_path / name)
