# SPDX-License-Identifier: Apache-2.0
"""`evaluate joints` with several people in images: PCK, OKS AP, counts, and truth by the names of images."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.cli import main

NAMES = ["left_shoulder", "right_shoulder", "left_elbow", "left_wrist", "left_hip", "right_hip"]
PLACES = np.array([[30.0, 0.0], [0.0, 0.0], [40.0, 30.0], [40.0, 60.0], [25.0, 80.0], [5.0, 80.0]])


def rows(x: float, confidence: float = 1.0) -> list[list[float]]:
    """Return the joints of a person at `x`, 80 px high."""
    return [[*(place + np.array([x, 0.0])).tolist(), confidence] for place in PLACES]


@pytest.fixture
def files(tmp_path: Path) -> list[str]:
    """A run on three images of 2, 1 and 0 annotated people, of whom it finds one, and its truth by name."""
    nobody: Any = [None, None, 0.0]
    images = {
        "a.jpg": [rows(1.0, 0.9), rows(5.0, 0.8)],
        "b.jpg": [rows(500.0, 0.95)],
        "c.jpg": [rows(40.0, 0.3)],
    }
    frames = [
        {
            "index": k,
            "path": f"/data/{name}",
            "puppets": [{"id": f"a{n}", "joints": one} for n, one in enumerate(people)],
        }
        for k, (name, people) in enumerate(images.items())
    ]
    truth = {"b.jpg": [rows(0.0)], "a.jpg": [[*rows(0.0)[:-1], nobody], rows(200.0)], "c.jpg": []}
    run, true = tmp_path / "poses.json", tmp_path / "truth.json"
    run.write_text(json.dumps({"joint_names": NAMES, "frames": frames}))
    true.write_text(json.dumps({"joint_names": NAMES, "frames": truth}))
    return ["evaluate", "joints", str(run), "--truth", str(true)]


def measure(command: list[str], capsys: pytest.CaptureFixture[str]) -> dict[str, float]:
    assert main([*command, "--json"]) == 0
    return dict(json.loads(capsys.readouterr().out)["poses"])


def test_people_in_images_by_name(files: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    figures = measure(files, capsys)
    assert figures["people"] == 3 and figures["people found"] == 1 and figures["people missed"] == 2
    assert figures["puppets twice on a person"] == 1 and figures["puppets on nobody annotated"] == 2
    assert figures["precision of people, %"] == 25
    assert figures["error of those found, median, % of extent"] == pytest.approx(100 / 80)
    # Five joints are 1 px off; the other twelve are of people whom no puppet is near.
    assert figures["PCK@0.2, %"] == pytest.approx(100 * 5 / 17)
    assert "PCKh@0.5, %" not in figures
    # One of three people is right, the second by score: 34 of 101 places on the curve have a precision of 1/2.
    assert figures["OKS AP50, %"] == pytest.approx(100 * 34 / 101 / 2)
    assert figures["OKS AR, %"] == pytest.approx(100 / 3)


@pytest.mark.slow
def test_the_file_says_in_which_image(files: list[str], tmp_path: Path) -> None:
    assert main([*files, "--out", str(tmp_path / "out")]) == 0
    images = json.loads((tmp_path / "out" / "joints.json").read_text())["images"]["poses"]
    assert images["a.jpg"]["people found"] == images["a.jpg"]["puppets twice on a person"] == 1
    assert images["b.jpg"]["people missed"] == images["c.jpg"]["puppets on nobody annotated"] == 1


def test_unmatched_people_may_be_unknown(files: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    figures = measure([*files, "--unmatched", "unknown"], capsys)
    assert figures["precision of people, %"] == 50 and figures["puppets on nobody annotated"] == 2
    assert figures["OKS AP50, %"] == pytest.approx(100 * 34 / 101)


def test_heads_give_pckh(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = ["head_top", "upper_neck", "left_wrist"]
    true, found = [[0, 0, 1], [0, 20, 1], [50, 50, 1]], [[0, 9, 1], [0, 31, 1], [50, 50, 1]]
    run, truth = tmp_path / "poses.json", tmp_path / "truth.json"
    run.write_text(json.dumps({"joint_names": names, "frames": [{"index": 4, "puppets": [{"joints": found}]}]}))
    truth.write_text(json.dumps({"joint_names": names, "frames": {"4": [true]}}))
    figures = measure(["evaluate", "joints", str(run), "--truth", str(truth)], capsys)
    assert figures["PCKh@0.5, %"] == pytest.approx(200 / 3) and "PCK@0.2, %" not in figures


def test_a_run_that_finds_nobody_misses_everybody(files: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    run = Path(files[2])
    data = json.loads(run.read_text())
    for frame in data["frames"]:
        frame["puppets"] = []
    run.write_text(json.dumps(data))
    figures = measure(files, capsys)
    assert figures["people missed"] == 3 and figures["PCK@0.2, %"] == 0 and figures["OKS AP, %"] == 0
    assert figures["precision of people, %"] is None


@pytest.mark.parametrize(
    ("frames", "says"),
    [
        ({"x.jpg": [rows(0.0)]}, "no image in common; the truth has x.jpg"),
        ({"a.jpg": [[[1.0, 2.0]]]}, "a person needs 6 entries"),
        ({"a.jpg": 3}, "must be an index or an image's name"),
        ({"a.jpg": [rows(0.0)], "data/a.jpg": []}, "the image data/a.jpg twice"),
    ],
)
def test_unusable_truth_is_one_sentence(
    frames: dict[str, Any], says: str, files: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    Path(files[4]).write_text(json.dumps({"joint_names": NAMES, "frames": frames}))
    assert main(files) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert says in line


def test_two_images_of_one_name_are_told_apart_by_their_folders(
    files: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    run, truth = Path(files[2]), Path(files[4])
    data = json.loads(run.read_text())
    data["frames"][1]["path"] = "/other/a.jpg"
    run.write_text(json.dumps(data))
    assert main(files) == 2
    assert "2 images a.jpg" in capsys.readouterr().err
    truth.write_text(json.dumps({"joint_names": NAMES, "frames": {"data/a.jpg": [rows(0.0)], "c.jpg": []}}))
    assert measure(files, capsys)["people found"] == 1
