# SPDX-License-Identifier: Apache-2.0
"""The recipe of the sample bag: cached and checked downloads, and keypoints in the right pixels and frames."""

import hashlib
import importlib.util
import json
import subprocess
import zipfile
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.errors import PuppetError
from flowing_puppet_ros.multiview.rig.files import read_rig

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


def test_keypoints_are_in_the_pixels_and_frames_of_the_videos(recipe: ModuleType, tmp_path: Path) -> None:
    """A keypoint of file 4 is one of frame 5, without the columns that its video lost; what was not found is null."""
    row = [100.0, 200.0, 0.7, 0.0, 0.0, 0.0] + [1.0, 2.0, 0.1] * 23
    with zipfile.ZipFile(tmp_path / "wheel.whl", "w") as archive:
        for camera in recipe.CROPS:
            for index in range(recipe.FRAMES):
                people = [{"pose_keypoints_2d": row}] if index == 4 else []
                name = f"Pose2Sim/Demo/pose/cam{camera[-1]}_json/{camera}.{index:04d}.json"
                archive.writestr(name, json.dumps({"people": people}))
    recipe.write_keypoints(tmp_path / "wheel.whl", tmp_path)
    for camera, left in (("cam01", 8), ("cam02", 4), ("cam03", 0)):
        frames = json.loads((tmp_path / f"{camera}.json").read_text())["frames"]
        assert sorted(map(int, frames)) == list(range(1, 100))
        assert frames["4"] == [] and frames["5"][0][:2] == [[100.0 - left, 200.0, 0.7], [None, None, 0.0]]


def test_the_calibration_is_that_of_the_videos(recipe: ModuleType) -> None:
    """The rotations and the size of the cropped videos are in the file, and the cameras look at the treadmill."""
    rig = read_rig(BAGS / "calibration.toml")
    assert list(rig.cameras) == list(recipe.CROPS)
    for name, crop in recipe.CROPS.items():
        camera = rig.cameras[name].camera
        assert camera.size == (1080 if crop else 1088, 1920)
        pixel, depth = camera.project(np.array([0.0, 0.0, 1.0]))
        assert depth > 2 and 0 < pixel[0] < camera.size[0] and 0 < pixel[1] < camera.size[1]
