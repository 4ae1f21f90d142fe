# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet evaluate pcp`: poses against the truth, every method on a folder, and what it refuses."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.cli import main
from flowing_puppet_ros.evaluate.image.pcp_methods import DETECTOR, METHODS
from flowing_puppet_ros.image.formats.stickmen import sticks_from_joints, write_sticks
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

MODEL = DeformableStructures.load()
JOINTS = MODEL.likely_puppet().joints * 70 + [110, 60]


def poses_file(path: Path, shift: float) -> Path:
    """Write a poses.json of two images whose second person is off by `shift` pixels and has a solution that is not."""
    right = JOINTS.tolist()
    frames = []
    for index, moved in enumerate((JOINTS, JOINTS + np.array([shift, 0.0]))):
        joints = np.column_stack([moved, np.ones(len(moved))]).tolist()
        puppet = {"joints": joints, "solutions": [{"joints": moved.tolist()}, {"joints": right}]}
        frames.append({"index": index, "path": f"folder/im{index}.png", "puppets": [puppet]})
    path.write_text(json.dumps({"joint_names": MODEL.joint_names, "frames": frames}))
    return path


@pytest.mark.parametrize("form", ["sticks.txt", "keypoints.json", "names.json", "annotations.json"])
def test_poses_against_every_form_of_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str], form: str) -> None:
    poses, truth = poses_file(tmp_path / "poses.json", 14.0), tmp_path / form
    people = [np.column_stack([JOINTS, np.ones(len(JOINTS))]).tolist()]
    if form == "sticks.txt":
        write_sticks(truth, {k: [sticks_from_joints(MODEL.joint_names, JOINTS)] for k in (0, 1)})
    elif form == "keypoints.json":
        truth.write_text(json.dumps({"joint_names": MODEL.joint_names, "frames": {"0": people, "1": people}}))
    elif form == "names.json":
        truth.write_text(
            json.dumps({"joint_names": MODEL.joint_names, "frames": {"im0.png": people, "im1.png": people}})
        )
    else:
        images = {f"im{k}.png": [{"joints": people[0]}] for k in (0, 1)}
        truth.write_text(json.dumps({"joint_names": MODEL.joint_names, "images": images}))
    assert main(["evaluate", "pcp", str(poses), "--truth", str(truth), "--json", "--pixels", "10"]) == 0
    figures = json.loads(capsys.readouterr().out)["poses"]
    assert figures["people"] == 2 and figures["found"] == 100
    assert figures["strict lower arms"] == 50 and figures["strict torso"] == 100
    assert figures["wrists within 10 px"] == 50 and figures["wrists of the best solution"] == 100
    # 14 px are more than a fifth of a torso of 35 px and than half a head of 18 px.
    assert figures["PCK@0.2, %"] == figures["PCKh@0.5, %"] == 50
    # The first of two is right at every threshold, up to a recall of 1/2: at 51 of 101 places.
    assert figures["OKS AP75, %"] == pytest.approx(100 * 51 / 101, abs=0.01)


def number_points(count: int, pairs_from: int | None = None) -> list[float]:
    """Return shoulders, elbows, wrists and hips in the order of COCO, where pairs begin at a number, or OpenPose's."""
    numbers = {
        "left_shoulder": 5, "right_shoulder": 2, "left_elbow": 6, "right_elbow": 3, "left_wrist": 7, "right_wrist": 4,
        "left_hip": 11, "right_hip": 8,
    }  # fmt: skip
    if pairs_from is not None:
        numbers = {name: pairs_from + k for k, name in enumerate(numbers)}
    values = [0.0] * (3 * count)
    for name, number in numbers.items():
        values[3 * number : 3 * number + 3] = [*JOINTS[MODEL.joint_names.index(name)], 1.0]
    return values


def test_poses_against_the_keypoints_of_other_detectors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    poses, results, folder = poses_file(tmp_path / "poses.json", 14.0), tmp_path / "results.json", tmp_path / "openpose"
    results.write_text(json.dumps([{"image_id": f"im{k}.jpg", "keypoints": number_points(17, 5)} for k in (0, 1)]))
    folder.mkdir()
    for k in (0, 1):
        frame = {"people": [{"pose_keypoints_2d": number_points(18)}]}
        (folder / f"im{k}_keypoints.json").write_text(json.dumps(frame))
    for truth in (results, folder):
        assert main(["evaluate", "pcp", str(poses), "--truth", str(truth), "--json", "--pixels", "10"]) == 0
        figures = json.loads(capsys.readouterr().out)["poses"]
        assert figures["people"] == 2 and figures["found"] == 100
        assert figures["strict lower arms"] == 50 and figures["strict torso"] == 100
        assert figures["wrists within 10 px"] == 50


@pytest.mark.slow
def test_one_command_measures_every_method(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number in (1, 2):
        assert cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((90, 100, 3), 60 * number, np.uint8))
    write_sticks(tmp_path / "sticks.txt", {k: [sticks_from_joints(MODEL.joint_names, JOINTS / 3)] for k in (1, 2)})
    out = tmp_path / "figures"
    flags = ["--truth", str(tmp_path / "sticks.txt"), "--out", str(out), "--particles", "8", "--iterations", "1"]
    assert main(["evaluate", "pcp", str(tmp_path), *flags]) == 0
    header, *lines = capsys.readouterr().out.splitlines()
    assert all(method in header for method in (DETECTOR, *METHODS))
    assert any(line.startswith("strict lower arms") for line in lines)
    figures = json.loads((out / "pcp.json").read_text())["figures"]
    assert list(figures) == [DETECTOR, *METHODS]
    assert all(row["people"] == 2 for row in figures.values())
    with (out / "pcp.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["figure", *figures]
    (found,) = (row for row in rows if row["figure"] == "found")
    assert float(found[DETECTOR]) == figures[DETECTOR]["found"]
    assert {path.name for path in out.glob("*.png")} == {"pcp-strict.png", "pcp-loose.png"}


@pytest.mark.parametrize("case", ["no truth", "no poses", "broken", "strangers", "pixels", "nobody", "no image"])
def test_unusable_input_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str], case: str) -> None:
    truth = tmp_path / "sticks.txt"
    write_sticks(truth, {k: [sticks_from_joints(MODEL.joint_names, JOINTS)] for k in (0, 1)})
    source, flags = poses_file(tmp_path / "poses.json", 0.0), ["--truth", str(truth)]
    if case == "no truth":
        flags = []
    if case == "no poses":
        source = tmp_path / "none.json"
    if case == "broken":
        source.write_text('{"frames": [{}], "joint_names": []}')
    if case == "strangers":
        write_sticks(truth, {77: [sticks_from_joints(MODEL.joint_names, JOINTS)]})
    if case == "pixels":
        flags += ["--pixels", "0"]
    if case == "nobody":
        truth.write_text("")
    if case == "no image":
        source = tmp_path
    assert main(["evaluate", "pcp", str(source), *flags]) == 2
    told = capsys.readouterr().err
    assert told.startswith("flowing-puppet evaluate: ") and told.count("\n") == 1
