# SPDX-License-Identifier: Apache-2.0
"""GLB files by the rules of glTF 2.0, and skinned here anew: they show the bodies that were written."""

import json
import shutil
import struct
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from flowing_puppet_ros.exchange.bones import NAMES
from flowing_puppet_ros.exchange.glb import write_glb
from flowing_puppet_ros.exchange.motion import BodyMotion

WIDTH = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}
TYPES = {5126: "<f4", 5121: "u1", 5123: "<u2"}
VALIDATE = (
    "const v=require('gltf-validator');v.validateBytes(new Uint8Array(require('fs').readFileSync(process.argv[1])))"
    ".then(r=>console.log(JSON.stringify(r.issues)))"
)


class Glb:
    """What a viewer reads: the JSON chunk, arrays, and the skinned mesh at a time of the animation."""

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        magic, version, length, size, kind = struct.unpack("<4sIIII", data[:20])
        assert (magic, version, length, kind) == (b"glTF", 2, len(data), 0x4E4F534A)
        self.document: dict[str, Any] = json.loads(data[20 : 20 + size])
        binary, mark = struct.unpack("<II", data[20 + size : 28 + size])
        assert mark == 0x004E4942
        self.binary = data[28 + size : 28 + size + binary]
        self.primitive = self.document["meshes"][0]["primitives"][0]

    def array(self, index: int) -> np.ndarray:
        """Return an accessor's rows."""
        accessor = self.document["accessors"][index]
        view = self.document["bufferViews"][accessor["bufferView"]]
        dtype = np.dtype(TYPES[accessor["componentType"]])
        assert view["byteOffset"] % dtype.itemsize == 0
        count = accessor["count"] * WIDTH[accessor["type"]]
        assert view["byteLength"] == count * dtype.itemsize
        flat = np.frombuffer(self.binary, dtype, count, view["byteOffset"])
        return flat.reshape(accessor["count"], -1).astype(np.float64)

    def attribute(self, name: str) -> np.ndarray:
        return self.array(self.primitive["attributes"][name])

    def bone_matrices(self, key: int | None = None) -> np.ndarray:
        """Return the matrices (B, 4, 4) of the nodes at rest or at a key of the animation."""
        nodes = [dict(node) for node in self.document["nodes"]]
        if key is not None:
            animation = self.document["animations"][0]
            for channel in animation["channels"]:
                sampler = animation["samplers"][channel["sampler"]]
                nodes[channel["target"]["node"]][channel["target"]["path"]] = self.array(sampler["output"])[key]
        matrices = np.tile(np.eye(4), (len(nodes), 1, 1))

        def place(index: int, above: np.ndarray) -> None:
            own = np.eye(4)
            own[:3, :3] = Rotation.from_quat(nodes[index].get("rotation", [0, 0, 0, 1])).as_matrix()
            own[:3, 3] = nodes[index].get("translation", [0, 0, 0])
            matrices[index] = above @ own
            for child in nodes[index].get("children", ()):
                place(child, matrices[index])

        for root in self.document["scenes"][0]["nodes"]:
            place(root, np.eye(4))
        return matrices[self.document["skins"][0]["joints"]]

    def skinned(self, key: int | None = None) -> np.ndarray:
        """Return the vertices (V, 3) as a viewer shows them."""
        inverse = self.array(self.document["skins"][0]["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
        moves = self.bone_matrices(key) @ inverse
        points = np.c_[self.attribute("POSITION"), np.ones(len(self.attribute("POSITION")))]
        joints = self.attribute("JOINTS_0").astype(int)
        moved = np.einsum("vkij,vj->vki", moves[joints], points)[..., :3]
        return np.asarray(np.einsum("vk,vki->vi", self.attribute("WEIGHTS_0"), moved))


@pytest.fixture(scope="module")
def walking(motion: BodyMotion, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("glb") / "walk.glb"
    write_glb(path, motion)
    return path


def test_the_mesh_of_one_frame_is_exact(still: BodyMotion, tmp_path: Path) -> None:
    write_glb(tmp_path / "still.glb", still)
    glb = Glb(tmp_path / "still.glb")
    np.testing.assert_allclose(glb.skinned(), still.vertices[0], atol=1e-5)
    assert "animations" not in glb.document
    mesh = trimesh.load(tmp_path / "still.glb", force="mesh", process=False)
    np.testing.assert_allclose(mesh.vertices, still.vertices[0], atol=1e-5)
    np.testing.assert_array_equal(mesh.faces, still.model.faces)
    assert mesh.volume > 0.03  # faces outwards


def test_the_animation_shows_every_frame(walking: Path, motion: BodyMotion) -> None:
    glb = Glb(walking)
    times = glb.array(glb.document["animations"][0]["samplers"][0]["input"])[:, 0]
    np.testing.assert_allclose(times, 0.04 * np.arange(len(motion.stamps_ns)), atol=1e-6)
    neck, wrist = NAMES.index("head"), NAMES.index("left_hand")
    errors = []
    for key in range(len(times)):
        places = glb.bone_matrices(key)[:, :3, 3]
        for bone, joint in ((neck, "neck"), (wrist, "left_wrist")):
            truth = motion.joints[key, motion.model.joint_names.index(joint)]
            np.testing.assert_allclose(places[bone], truth, atol=1e-5)
        errors.append(np.linalg.norm(glb.skinned(key) - motion.vertices[key], axis=1))
    assert np.mean(errors) < 0.01
    moved = np.linalg.norm(motion.vertices - motion.vertices[:1], axis=2)
    assert np.mean(moved[-1]) > 0.05, "the motion would be seen if it were not followed"


def test_rules_of_the_format(walking: Path) -> None:
    glb = Glb(walking)
    document = glb.document
    assert document["buffers"][0]["byteLength"] <= len(glb.binary)
    for index, accessor in enumerate(document["accessors"]):
        values = glb.array(index)
        assert np.isfinite(values).all()
        if "min" in accessor:
            np.testing.assert_array_equal(np.float32(accessor["min"]), np.float32(values.min(axis=0)))
            np.testing.assert_array_equal(np.float32(accessor["max"]), np.float32(values.max(axis=0)))
    assert "min" in document["accessors"][glb.primitive["attributes"]["POSITION"]]
    np.testing.assert_allclose(glb.attribute("WEIGHTS_0").sum(axis=1), 1, atol=1e-6)
    assert not glb.attribute("JOINTS_0")[glb.attribute("WEIGHTS_0") == 0].any()
    np.testing.assert_allclose(np.linalg.norm(glb.attribute("NORMAL"), axis=1), 1, atol=1e-5)
    assert glb.array(glb.primitive["indices"]).max() == len(glb.attribute("POSITION")) - 1
    for sampler in document["animations"][0]["samplers"]:
        output = glb.array(sampler["output"])
        assert len(output) == len(glb.array(sampler["input"]))
        if output.shape[1] == 4:
            np.testing.assert_allclose(np.linalg.norm(output, axis=1), 1, atol=1e-5)
            assert (np.einsum("ti,ti->t", output[1:], output[:-1]) > 0).all(), "no turn the long way around"


@pytest.mark.slow
def test_the_validator_of_the_format_finds_nothing(walking: Path) -> None:
    """Where Node.js has the package gltf-validator of the format's authors (`npm install gltf-validator`)."""
    node = shutil.which("node")
    if node is None or subprocess.run([node, "-e", "require('gltf-validator')"], capture_output=True).returncode:
        pytest.skip("there is no gltf-validator")
    done = subprocess.run([node, "-e", VALIDATE, str(walking)], capture_output=True, text=True, check=True)
    issues = json.loads(done.stdout)
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]
