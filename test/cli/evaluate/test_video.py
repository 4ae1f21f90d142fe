# SPDX-License-Identifier: Apache-2.0
"""`evaluate video`: clips and truths in every form, figures that can be checked by hand, tracks kept for later."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.cli import main
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.video.errors import (
    TrackedPerson,
    calibration_error,
    measure_calibration,
    measure_clip,
    measure_gain,
    summarise,
)
from flowing_puppet_ros.evaluate.video.methods import LocatedPerson, filter_by_median
from flowing_puppet_ros.evaluate.video.truth import find_clips, read_people
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

MODEL = DeformableStructures.load()
PUPPET = MODEL.puppet_from_joints(MODEL.mean_joints() * 150 + [150, 110], 150.0)
ARMS = ("right_elbow", "left_elbow", "right_wrist", "left_wrist")


def draw_clip(folder: Path, frames: int, speed: float) -> np.ndarray:
    """Write frames of the mean puppet that moves to the right; returns its joints (T,J,2)."""
    rng = np.random.default_rng(3)
    ground, skin = (cv2.resize(rng.integers(0, 255, (40, 60, 3)).astype(np.uint8), (320, 240)) for _ in range(2))
    mask = np.zeros((240, 320), np.uint8)
    for contour in PUPPET.contours:
        cv2.fillPoly(mask, [np.round(contour).astype(np.int32)], 1)
    folder.mkdir(parents=True)
    for k in range(frames):
        move = np.array([[1, 0, speed * k], [0, 1, 0]], float)
        image = ground.copy()
        cv2.copyTo(cv2.warpAffine(skin, move, (320, 240)), cv2.warpAffine(mask, move, (320, 240)), image)
        cv2.imwrite(str(folder / f"{k}.png"), image)
    return PUPPET.joints + np.arange(frames)[:, None, None] * [speed, 0.0]


def of_clips(joints: dict[str, np.ndarray]) -> dict[str, Any]:
    return {
        "joint_names": list(MODEL.joint_names),
        "clips": {name: {"exact": True, "joints": places.tolist()} for name, places in joints.items()},
    }


@pytest.fixture
def clips(tmp_path: Path) -> tuple[Path, Path, Path]:
    """A folder of two clips, their truth, and shaken keypoints of them."""
    rng = np.random.default_rng(1)
    joints = {name: draw_clip(tmp_path / "clips" / name, 5, speed) for name, speed in (("a", 2.0), ("b", -1.0))}
    truth, init = tmp_path / "truth.json", tmp_path / "init.json"
    truth.write_text(json.dumps(of_clips(joints)))
    init.write_text(json.dumps(of_clips({name: at + rng.normal(0, 6, at.shape) for name, at in joints.items()})))
    return tmp_path / "clips", truth, init


def test_rows_from_given_keypoints_are_measured_and_kept(
    clips: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, truth, init = clips
    command = ["evaluate", "video", str(folder), "--truth", str(truth), "--init", str(init), "--processes", "1"]
    command += ["--methods", "init-detector,init-default,init-detector-median", "--out", str(tmp_path / "out")]
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "init-default over init-detector: elbows within 10 px" in printed
    assert "method                hota" in printed
    rows = json.loads((tmp_path / "out" / "video.json").read_text())["methods"]
    assert rows["init-default"]["wrists_median_px"] < rows["init-detector"]["wrists_median_px"]
    assert rows["init-default"]["wrists_shake_px"] < 0.5 * rows["init-detector"]["wrists_shake_px"]
    assert rows["init-detector-median"]["wrists_shake_px"] < rows["init-detector"]["wrists_shake_px"]
    # One person a clip, whom both keep under one id; 6 px of noise cost places, not identities.
    assert rows["init-default"]["idf1"] == rows["init-default"]["mota"] == 100.0
    assert rows["init-default"]["id_switches"] == 0 and rows["init-detector"]["hota"] < rows["init-default"]["hota"]
    assert "Calibration" in (tmp_path / "out" / "video.html").read_text()
    kept = tmp_path / "out" / "init-default" / "a.json"
    data = json.loads(kept.read_text())
    for frame in data["frames"]:
        frame["puppets"] = []
    kept.write_text(json.dumps(data))
    assert main([*command, "--clips", "a", "--json"]) == 0
    again = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert again["init-default"]["wrists_20_px"] == 0.0, "the tracks that are there are measured"
    assert again["init-default"]["hota"] == again["init-default"]["mota"] == 0.0
    assert main([*command, "--clips", "a", "--json", "--again"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["init-default"]["wrists_20_px"] > 50.0


@pytest.mark.slow
def test_two_processes_give_the_bytes_of_one(clips: tuple[Path, Path, Path], tmp_path: Path) -> None:
    folder, truth, init = clips
    texts = []
    for count in (1, 2):
        out = tmp_path / str(count)
        command = ["evaluate", "video", str(folder), "--truth", str(truth), "--init", str(init), "--out", str(out)]
        assert main([*command, "--methods", "init-live", "--processes", str(count)]) == 0
        texts.append([(out / "init-live" / f"{name}.json").read_bytes() for name in ("a", "b")])
    assert texts[0] == texts[1]


def person(move: float, confidence: float = 1.0) -> TrackedPerson:
    return TrackedPerson.of(
        MODEL.joint_names, PUPPET.joints + np.array([move, 0.0]), np.full(len(PUPPET.joints), confidence)
    )


def true_people(frames: int) -> dict[int, list[Keypoints]]:
    seen = np.array([float(name in ARMS) for name in MODEL.joint_names])
    return {k: [Keypoints(MODEL.joint_names, PUPPET.joints, seen)] for k in range(frames)}


def test_figures_of_known_misses() -> None:
    misses = [0.0, 0.0, 15.0, 0.0]
    track = {k: [person(miss, 0.95 if miss == 0 else 0.35)] for k, miss in enumerate(misses)}
    errors = measure_clip(track, true_people(5), (320, 240))
    figures = summarise({"a": errors})
    assert figures["elbows_10_px"] == 60.0, "three of five: one is off, one frame has nobody"
    assert figures["wrists_20_px"] == 80.0
    np.testing.assert_allclose(sorted(errors.jitter["wrist"]), [15, 15, 30, 30], atol=1e-9)
    rows = measure_calibration({"a": errors})
    assert [(row["confidence"], row["right"], row["joints"]) for row in rows] == [(0.35, 1.0, 4.0), (0.95, 1.0, 12.0)]
    assert calibration_error(rows) == pytest.approx((4 * 0.65 + 12 * 0.05) / 16, abs=1e-3)
    perfect = measure_clip({k: [person(0.0)] for k in range(5)}, true_people(5), (320, 240))
    points, low, high = measure_gain({"a": perfect, "b": errors}, {"a": errors, "b": errors}, "elbow", 10.0)
    assert points == 20.0
    assert (low, high) == (0.0, 40.0)


def test_joints_outside_the_image_are_not_asked_and_the_nearest_puppet_answers() -> None:
    errors = measure_clip({0: [person(100.0), person(1.0)]}, true_people(1), (320, 240))
    assert len(errors.distance["wrist"]) == 2
    np.testing.assert_allclose(errors.distance["wrist"], 1.0)
    narrow = int(PUPPET.joints[[MODEL.joint_names.index("right_wrist")], 0][0]) + 2
    assert len(measure_clip({0: [person(1.0)]}, true_people(1), (narrow, 240)).distance["wrist"]) == 1


def test_the_median_filter_mends_one_frame_and_keeps_ends() -> None:
    track = [[LocatedPerson("a1", np.full((1, 2), x), np.ones(1))] for x in (1.0, 50.0, 3.0, 4.0)]
    assert [people[0].joints[0, 0] for people in filter_by_median(track)] == [1.0, 3.0, 4.0, 4.0]


def test_truths_in_every_form(clips: tuple[Path, Path, Path], tmp_path: Path) -> None:
    folder, truth, _ = clips
    found = find_clips(folder)
    assert list(found) == ["a", "b"]
    people = read_people(truth, found)
    assert people["b"][4][0].select_usable()["left_wrist"][0] == pytest.approx(PUPPET.joints[-3, 0] - 4.0)
    row = [[1.0, 2.0, 1.0]] * len(MODEL.joint_names)
    tool = tmp_path / "tool.json"
    tool.write_text(
        json.dumps({"joint_names": list(MODEL.joint_names), "images": {"clips/a/3.png": [{"joints": row}]}})
    )
    assert list(read_people(tool, found)["a"]) == [3]
    own = tmp_path / "own"
    own.mkdir()
    (own / "b.json").write_text(json.dumps({"joint_names": list(MODEL.joint_names), "frames": {"2": [row]}}))
    assert {name: list(frames) for name, frames in read_people(own, found).items()} == {"b": [2]}
    assert list(read_people(own / "b.json", find_clips(folder / "b"))["b"]) == [2]


def test_other_detectors_people_go_to_the_clips_that_their_frames_are_named_after(
    clips: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    found = find_clips(clips[0])
    values = [0.0] * 51
    values[27:30] = [11.0, 22.0, 0.5]  # the left wrist is COCO's ninth, counted from 0
    results = tmp_path / "results.json"
    results.write_text(
        json.dumps([{"image_id": f"{name}/{k}.jpg", "keypoints": values} for name, k in (("a", 1), ("b", 3))])
    )
    assert {name: list(frames) for name, frames in read_people(results, found).items()} == {"a": [1], "b": [3]}
    folder = tmp_path / "json"
    for name, k in (("a", 2), ("b", 0), ("c", 1)):
        (folder / name).mkdir(parents=True)
        text = json.dumps({"people": [{"pose_keypoints_2d": values}]})
        (folder / name / f"{name}_{k:012d}_keypoints.json").write_text(text)
        (folder / f"{name}_{k:012d}_keypoints.json").write_text(text)
    assert {name: list(frames) for name, frames in read_people(folder, found).items()} == {"a": [2], "b": [0]}
    for name in "abc":
        for file in (folder / name).iterdir():
            file.unlink()
    people = read_people(folder, found)
    assert {name: list(frames) for name, frames in people.items()} == {"a": [2], "b": [0]}, "all in one folder"
    assert people["a"][2][0].select_usable() == {"left_wrist": (11.0, 22.0, 0.5)}
    results.write_text(json.dumps([{"people": [{"pose_keypoints_2d": values}]}]))
    with pytest.raises(InputError, match="has the frames of one clip, but there are 2"):
        read_people(results, found)
    results.write_text(json.dumps([{"image_id": "z/1.jpg", "keypoints": values}]))
    with pytest.raises(InputError, match="no person in any of the clips a, b"):
        read_people(results, found)


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (["--methods", "magic"], "no method 'magic'"),
        (["--methods", "init-live"], "name them with --init"),
        (["--clips", "z"], "has no clip 'z'"),
        (["--processes", "0"], "--processes is 0"),
        (["--truth", "none.json"], "none.json cannot be read"),
    ],
)
def test_bad_arguments_are_one_sentence(
    flags: list[str], says: str, clips: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, truth, _ = clips
    command = ["evaluate", "video", str(folder), "--truth", str(truth), "--out", str(tmp_path / "out")]
    assert main([*command, *flags]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert says in line
