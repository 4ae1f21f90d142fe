# SPDX-License-Identifier: Apache-2.0
"""Folders of tiny videos into bags: messages against the calibration and keypoints that were given, and odd folders."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from walkers import NAMES, photograph, ring, walker  # type: ignore[import-not-found]

from flowing_puppet_ros import cli
from flowing_puppet_ros.bag.cameras.recorded_rig import read_people, read_recorded_rig
from flowing_puppet_ros.bag.cameras.sources import match_names
from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.rig.files import read_rig, write_rig
from flowing_puppet_ros.multiview.rig.rig import CameraRig, RigCamera
from flowing_puppet_ros.stream.messages.geometry import stamp_ns
from flowing_puppet_ros.stream.messages.images import decode_image

SIZE = (96, 54)
START = 1_700_000_000 * 10**9
CAMERAS = {name: camera.resize(SIZE) for name, camera in ring(3).items()}


def make_video(path: Path, count: int, fps: float = 25.0, size: tuple[int, int] = SIZE) -> None:
    """Write a video whose frames get brighter."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), fps, size)
    for k in range(count):
        writer.write(np.full((size[1], size[0], 3), 20 + 8 * k, np.uint8))
    writer.release()


def make_folder(folder: Path, counts: tuple[int, ...] = (6, 6, 6), people: bool = True, unit: float = 1.0) -> Path:
    """Write videos, keypoints and a calibration, and return its path."""
    random = np.random.default_rng(0)
    keypoints: dict[str, dict[str, Any]] = {name: {} for name in CAMERAS}
    for k in range(max(counts)):
        seen = photograph(CAMERAS, {"ann": walker((0.1 * k, 0.0), 0.4, k)}, 0.0, random)
        for name, group in seen.items():
            keypoints[name][str(k)] = [np.column_stack([p.joints, p.confidence]).tolist() for p in group]
    for (name, frames), count in zip(keypoints.items(), counts, strict=True):
        make_video(folder / f"{name}.avi", count)
        if people:
            (folder / f"{name}.json").write_text(json.dumps({"joint_names": NAMES, "frames": frames}))
    rig = CameraRig({name: RigCamera(camera) for name, camera in CAMERAS.items()}, "m").rescale(unit)
    rig = CameraRig({name: replace(e, time_offset=0.01 * (name == "cam2")) for name, e in rig.cameras.items()})
    write_rig(rig, folder / "calib.toml")
    return folder / "calib.toml"


def run(folder: Path, *more: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, Any], str]:
    """Import a folder and return the exit status, the summary and stderr."""
    arguments = [str(folder), "--calibration", str(folder / "calib.toml"), "--out", str(folder / "bag.mcap"), "--json"]
    status = cli.main(["import", *arguments, *more])
    captured = capsys.readouterr()
    return status, json.loads(captured.out) if captured.out else {}, captured.err


def test_a_folder_becomes_a_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_folder(tmp_path)
    status, summary, _ = run(tmp_path, capsys=capsys)
    assert status == 0 and summary["warnings"] == []
    assert summary["images"] == summary["detections"] == {"cam1": 6, "cam2": 6, "cam3": 6}
    with open_bag(tmp_path / "bag.mcap") as bag:
        records = [(record.topic, record.log_time, record.message) for record in bag.messages()]
    assert [time for _, time, _ in records] == sorted(time for _, time, _ in records)
    images = [message for topic, _, message in records if topic == "/cam2/image/compressed"]
    assert [stamp_ns(m) - START for m in images] == [10_000_000 + 40_000_000 * k for k in range(6)]  # with its offset
    assert decode_image(images[3]).mean() == pytest.approx(44, abs=2)
    recorded = read_recorded_rig(tmp_path / "bag.mcap", pytest.fail)
    for name, each in recorded.rig.cameras.items():
        point = np.array([0.2, -0.3, 1.2])
        np.testing.assert_allclose(each.camera.project(point)[0], CAMERAS[name].project(point)[0], atol=1e-6)
    detection = next(message for topic, _, message in records if topic == "/cam3/detections")
    expected, _ = CAMERAS["cam3"].project(walker((0.0, 0.0), 0.4, 0))
    found = {joint.name: (joint.x, joint.y) for joint in detection.puppets[0].joints}
    np.testing.assert_allclose([found[name] for name in NAMES], expected, atol=1e-3)


def test_a_wrong_unit_is_one_sentence_and_no_giant(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_folder(tmp_path, unit=1000.0)
    status, _, err = run(tmp_path, "--unit", "m", capsys=capsys)
    assert status == 2 and err.count("\n") == 1 and "m tall: the calibration is in mm" in err
    assert not (tmp_path / "bag.mcap").exists()
    status, summary, _ = run(tmp_path, capsys=capsys)
    assert status == 0 and "taken to be in mm" in summary["warnings"][0]


def test_videos_of_different_lengths_and_rates_lose_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_folder(tmp_path, (9, 3, 9), people=False)
    make_video(tmp_path / "cam3.avi", 9, fps=50.0)
    arguments = "--unit", "m", "--up", "z"
    status, summary, _ = run(tmp_path, *arguments, capsys=capsys)
    told = " ".join(summary["warnings"])
    assert status == 0 and summary["images"] == {"cam1": 9, "cam2": 3, "cam3": 9}
    assert "different rates (cam1 25, cam2 25, cam3 50 images a second)" in told and "different lengths" in told


def test_a_missing_camera_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_folder(tmp_path)
    (tmp_path / "cam3.avi").rename(tmp_path / "cam9.avi")
    status, summary, _ = run(tmp_path, capsys=capsys)
    assert status == 0 and summary["cameras"] == ["cam1", "cam2"]
    assert "the calibration has no camera for cam9, which is left out; it has cam1, cam2, cam3" in summary["warnings"]
    assert "there is no video of cam3, which is calibrated: it is left out" in summary["warnings"]
    (tmp_path / "cam2.avi").unlink()
    (tmp_path / "cam1.avi").unlink()
    status, _, err = run(tmp_path, capsys=capsys)
    assert status == 2 and "has no two videos and no two folders of images" in err


def test_image_folders_and_a_project_with_videos_inside(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_folder(tmp_path, people=False)
    for name in CAMERAS:
        (tmp_path / f"{name}.avi").unlink()
        folder = tmp_path / "images" / name
        folder.mkdir(parents=True)
        for k in range(3):
            cv2.imwrite(str(folder / f"{k}.png"), np.full((SIZE[1], SIZE[0], 3), 50 * k, np.uint8))
    status, summary, _ = run(tmp_path, "--fps", "10", "--unit", "m", "--up", "z", capsys=capsys)
    assert status == 0 and summary["images"] == {"cam1": 3, "cam2": 3, "cam3": 3}
    with open_bag(tmp_path / "bag.mcap") as bag:
        stamps = [stamp_ns(record.message) - START for record in bag.messages(["/cam1/image/compressed"])]
    assert stamps == [0, 100_000_000, 200_000_000]


def test_names_are_matched_by_their_sense() -> None:
    told: list[str] = []
    assert match_names(["cam01", "cam02"], ["cam_1", "Cam 2"], told.append) == {"cam01": "cam_1", "cam02": "Cam 2"}
    assert match_names(["port_0", "port_1"], ["cam_0", "cam_1"], told.append) == {"port_0": "cam_0", "port_1": "cam_1"}
    assert told == []
    with pytest.raises(InputError, match="have different names: give them the same"):
        match_names(["left", "right"], ["a", "b"], told.append)


def test_a_bag_is_calibrated_from_its_puppets(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The detections of the bag are tracked and the calibration written; the pixels are exact, so it stays the same."""
    make_folder(tmp_path, (12, 12, 12))
    run(tmp_path, capsys=capsys)
    recorded = read_recorded_rig(tmp_path / "bag.mcap", pytest.fail)
    names, frames = read_people(tmp_path / "bag.mcap", recorded, None, pytest.fail)
    assert "left_wrist" in names and {name: len(group) for name, group in frames.items()} == dict.fromkeys(CAMERAS, 12)
    out = tmp_path / "better.toml"
    status = cli.main(["calibrate", str(tmp_path / "bag.mcap"), "--out", str(out), "--no-clocks", "--json"])
    report = json.loads(capsys.readouterr().out)
    assert status == 0 and report["after_px"]["mean"] <= report["before_px"]["mean"] + 0.05
    for name, each in read_rig(out).cameras.items():
        np.testing.assert_allclose(each.camera.centre, CAMERAS[name].centre, atol=0.05)


def test_unusable_arguments_are_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_folder(tmp_path)
    for arguments, sentence in [
        (("--crop", "cam1=8"), "give CAMERA=LEFT,TOP"),
        (("--crop", "cam7=8,0"), "the cameras are cam1, cam2, cam3"),
        (("--fps", "-1"), "--fps is -1: give a positive number"),
    ]:
        status, _, err = run(tmp_path, *arguments, capsys=capsys)
        assert status == 2 and sentence in err
    assert (
        cli.main(["import", str(tmp_path / "none"), "--calibration", str(tmp_path / "calib.toml"), "--out", "x"]) == 2
    )
    assert "give the folder with one video" in capsys.readouterr().err
