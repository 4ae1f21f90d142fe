# SPDX-License-Identifier: Apache-2.0
"""Write a person as binary glTF 2.0: mesh, skeleton with skinning, and the animation of several frames.

Metres, y up, z forward, as glTF has it (Khronos, glTF 2.0 specification). The mesh of one frame is exact. That of
several frames is skinned, so it follows the bodies within about a centimetre; the joints follow exactly, since bones
also shift.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from flowing_puppet_ros import __version__
from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.exchange.bones import BONES, NAMES, PARENTS, BonePoses
from flowing_puppet_ros.exchange.motion import BodyMotion
from flowing_puppet_ros.exchange.skinning import bind, weigh_bones
from flowing_puppet_ros.units import NANOSECONDS

_FLOAT, _UINT8, _UINT16 = 5126, 5121, 5123
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963
_SKIN_RGBA = (0.85, 0.68, 0.55, 1.0)
_MESH_NODE = len(BONES)


class _Buffer:
    """The binary chunk and its views and accessors."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, values: Array, component: int, kind: str, target: int = 0, bounds: bool = False) -> int:
        """Add an array as an accessor and return its index."""
        types = {_FLOAT: "<f4", _UINT8: "u1", _UINT16: "<u2"}
        stored = np.ascontiguousarray(values, types[component])
        self.data += bytes(-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": stored.nbytes}
        self.views.append(view | ({"target": target} if target else {}))
        self.data += stored.tobytes()
        rows = stored.reshape(len(stored), -1)
        limits = {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()} if bounds else {}
        about = {"bufferView": len(self.views) - 1, "componentType": component, "count": len(stored), "type": kind}
        self.accessors.append(about | limits)
        return len(self.accessors) - 1


def write_glb(path: Path, motion: BodyMotion) -> None:
    """Write mesh, skeleton and animation of a person."""
    buffer = _Buffer()
    mesh = _make_mesh(buffer, motion)
    inverse = _invert(motion.bones)
    skin = {
        "name": motion.name,
        "joints": list(range(len(BONES))),
        "skeleton": 0,
        # glTF stores matrices by columns.
        "inverseBindMatrices": buffer.add(np.swapaxes(inverse, 1, 2).reshape(-1, 16), _FLOAT, "MAT4"),
    }
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"flowing_puppet_ros {__version__}"},
        "scene": 0,
        "scenes": [{"name": motion.name, "nodes": [0, _MESH_NODE]}],
        "nodes": [*_make_bone_nodes(motion.bones), {"name": "body", "mesh": 0, "skin": 0}],
        "meshes": [mesh],
        "skins": [skin],
        "materials": [_make_material()],
    }
    if len(motion.stamps_ns) > 1:
        document["animations"] = [_make_animation(buffer, motion)]
    document |= {"bufferViews": buffer.views, "accessors": buffer.accessors}
    document["buffers"] = [{"byteLength": len(buffer.data)}]
    _write_chunks(path, document, bytes(buffer.data))


def _make_material() -> dict[str, Any]:
    surface = {"baseColorFactor": list(_SKIN_RGBA), "metallicFactor": 0.0, "roughnessFactor": 0.8}
    return {"name": "skin", "pbrMetallicRoughness": surface}


def _make_mesh(buffer: _Buffer, motion: BodyMotion) -> dict[str, Any]:
    """Return the mesh in the pose of the first frame."""
    vertices, faces = bind(motion.model, motion.bones, motion.vertices), motion.model.faces
    chosen, weight = weigh_bones(motion.model)
    attributes = {
        "POSITION": buffer.add(vertices, _FLOAT, "VEC3", _ARRAY_BUFFER, bounds=True),
        "NORMAL": buffer.add(vertex_normals(vertices, faces), _FLOAT, "VEC3", _ARRAY_BUFFER),
        # A bone without weight is to be 0.
        "JOINTS_0": buffer.add(np.where(weight > 0, chosen, 0), _UINT8, "VEC4", _ARRAY_BUFFER),
        "WEIGHTS_0": buffer.add(weight, _FLOAT, "VEC4", _ARRAY_BUFFER),
    }
    indices = buffer.add(np.asarray(faces).reshape(-1), _UINT16, "SCALAR", _ELEMENT_ARRAY_BUFFER)
    return {"name": "body", "primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}


def _invert(bones: BonePoses) -> Array:
    """Return the matrices (B, 4, 4) from the first frame's mesh into each bone's axes."""
    inverse = np.zeros((len(BONES), 4, 4))
    inverse[:, :3, :3] = np.swapaxes(bones.rotation[0], 1, 2)
    inverse[:, :3, 3] = -np.einsum("bji,bj->bi", bones.rotation[0], bones.position[0])
    inverse[:, 3, 3] = 1.0
    return inverse


def _find_local(bones: BonePoses) -> tuple[Array, Array]:
    """Return turn as quaternions (T, B, 4), x y z w, and place (T, B, 3) of every bone in its parent's axes."""
    turn = Rotation.from_matrix(bones.local_rotations().reshape(-1, 3, 3)).as_quat()
    turn = turn.reshape(*bones.position.shape[:2], 4)
    for t in range(1, len(turn)):  # the two signs of a rotation must not alternate
        turn[t] *= np.where((turn[t] * turn[t - 1]).sum(axis=-1, keepdims=True) < 0, -1, 1)
    place = bones.position.copy()
    for bone, parent in enumerate(PARENTS):
        if parent >= 0:
            step = bones.position[:, bone] - bones.position[:, parent]
            place[:, bone] = np.einsum("tji,tj->ti", bones.rotation[:, parent], step)
    return turn, place


def _make_bone_nodes(bones: BonePoses) -> list[dict[str, Any]]:
    turn, place = _find_local(bones)
    nodes = []
    for bone, name in enumerate(NAMES):
        node: dict[str, Any] = {
            "name": name,
            "rotation": _as_unit(turn[0, bone]),
            "translation": place[0, bone].astype(np.float32).tolist(),
        }
        children = [child for child, parent in enumerate(PARENTS) if parent == bone]
        nodes.append(node | ({"children": children} if children else {}))
    return nodes


def _as_unit(quaternion: Array) -> list[float]:
    return [float(value) for value in quaternion / np.linalg.norm(quaternion)]


def _make_animation(buffer: _Buffer, motion: BodyMotion) -> dict[str, Any]:
    """Return the animation of all bones over the stamps, from 0 s."""
    turn, place = _find_local(motion.bones)
    seconds = (motion.stamps_ns - motion.stamps_ns[0]) / NANOSECONDS
    times = buffer.add(seconds, _FLOAT, "SCALAR", bounds=True)
    channels: list[dict[str, Any]] = []
    samplers: list[dict[str, Any]] = []
    for path, values, kind in (("rotation", turn, "VEC4"), ("translation", place, "VEC3")):
        for bone in range(len(BONES)):
            channels.append({"sampler": len(samplers), "target": {"node": bone, "path": path}})
            output = buffer.add(values[:, bone], _FLOAT, kind)
            samplers.append({"input": times, "output": output, "interpolation": "LINEAR"})
    return {"name": motion.name, "channels": channels, "samplers": samplers}


def _write_chunks(path: Path, document: dict[str, Any], binary: bytes) -> None:
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    length = 12 + 8 + len(text) + 8 + len(binary)
    with path.open("wb") as stream:
        stream.write(struct.pack("<4sII", b"glTF", 2, length))
        stream.write(struct.pack("<I4s", len(text), b"JSON") + text)
        stream.write(struct.pack("<I4s", len(binary), b"BIN\0") + binary)
