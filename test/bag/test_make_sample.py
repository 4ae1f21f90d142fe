# SPDX-License-Identifier: Apache-2.0
"""The recipe of the sample bag: cached and checked downloads, and messages in the right pixels and frames."""

import hashlib
import importlib.util
import subprocess
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.errors import PuppetError
from flowing_puppet_ros.stream.messages.geometry import FrameTree
from flowing_puppet_ros.stream.messages.images import decode_image

BAGS = Path(__file__).resolve().parents[2] / "bags"


@pytest.fixture(scope="module")
def recipe() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_sample", BAGS / "make_sample.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def source(content: bytes) -> dict[str, Any]:
    return {
        "requirement": "thing==1.0",
        "file": "thing-1.0.whl",
        "sha256": hashlib.sha256(content).hexdigest(),
        "bytes": len(content),
    }


def pip(content: bytes | None, calls: list[list[str]]) -> Any:
    """A pip that downloads `content`, or nothing for want of a network."""

    def run(command: list[str], **_: Any) -> subprocess.CompletedProcess[bytes]:
        calls.append(command)
        if content is not None:
            (Path(command[command.index("--dest") + 1]) / "thing-1.0.whl").write_bytes(content)
        return subprocess.CompletedProcess(command, 0 if content is not None else 1)

    return run


def test_a_download_is_made_once(recipe: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[list[str]] = []
    monkeypatch.setattr(recipe.subprocess, "run", pip(b"wheel", calls))
    for _ in range(2):
        assert recipe.fetch(source(b"wheel"), tmp_path / "cache").read_bytes() == b"wheel"
    assert len(calls) == 1
    assert {"--no-deps", "thing==1.0"} <= set(calls[0])
    (tmp_path / "cache" / "thing-1.0.whl").write_bytes(b"rotten")
    assert recipe.fetch(source(b"wheel"), tmp_path / "cache").read_bytes() == b"wheel"
    assert len(list((tmp_path / "cache").iterdir())) == 1


@pytest.mark.parametrize(
    ("content", "sentence"), [(None, "check the network, or put thing-1.0.whl in"), (b"other", "another sha256")]
)
def test_a_failed_download_is_one_sentence(
    recipe: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes | None, sentence: str
) -> None:
    monkeypatch.setattr(recipe.subprocess, "run", pip(content, []))
    with pytest.raises(PuppetError, match=sentence):
        recipe.fetch(source(b"wheel"), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_messages_are_in_the_pixels_and_frames_of_the_videos(recipe: ModuleType, tmp_path: Path) -> None:
    """A world point projected with the bag's camera_info and /tf_static lands on its cropped keypoint."""
    calibration = tomllib.loads((BAGS / "calibration.toml").read_text())
    point, seen = np.array([0.3, -0.2, 1.1]), {}
    with BagWriter(tmp_path / "bag.mcap") as writer:
        maker = recipe.Recipe(writer, calibration)
        maker.write_cameras()
        for name, c in calibration.items():
            lens = np.array(c["matrix"]), np.array(c["distortion"])
            pixel, _ = cv2.projectPoints(point, np.array(c["rotation"]), np.array(c["translation"]), *lens)
            person = np.zeros((25, 3))
            person[3] = [*pixel.ravel(), 0.7]
            maker.write_detections(name, 50, [person])
            seen[name] = pixel.ravel() - [c["crop"], 0]
            maker.write_image(name, 50, np.full((1920, c["video_size"][0], 3), 90, np.uint8))
    with open_bag(tmp_path / "bag.mcap") as bag:
        found: dict[str, Any] = {record.topic: record.message for record in bag.messages()}
    frames = FrameTree()
    frames.add(found["/tf_static"])
    for name in calibration:
        info = found[f"/{name}/camera_info"]
        placed = frames.lookup_pose(info.header.frame_id, frames.find_root(info.header.frame_id))
        assert placed is not None
        position, rotation = placed
        local = rotation.T @ (point - position)
        pixel, _ = cv2.projectPoints(local, np.zeros(3), np.zeros(3), info.k.reshape(3, 3), info.d)
        np.testing.assert_allclose(pixel.ravel(), seen[name], atol=1e-3)
        joint = found[f"/{name}/detections"].puppets[0].joints[3]
        np.testing.assert_allclose([joint.x, joint.y], seen[name], atol=1e-3)
        assert joint.name == "LEar"
        assert np.isnan(found[f"/{name}/detections"].puppets[0].joints[0].x)
        assert decode_image(found[f"/{name}/image/compressed"]).shape == (info.height, info.width, 3)
        assert local[2] > 0


def test_keypoints_lag_the_video_by_one_frame(recipe: ModuleType) -> None:
    asked: list[str] = []

    class Archive:
        def read(self, name: str) -> str:
            asked.append(name)
            return '{"people": []}'

    assert recipe.people(Archive(), "cam02", 0) is None
    assert recipe.people(Archive(), "cam02", 1) == []
    assert asked == ["Pose2Sim/Demo/pose/cam2_json/cam02.0000.json"]
