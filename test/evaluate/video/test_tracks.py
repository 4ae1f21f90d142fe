# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet evaluate joints`: accuracy of 2D joints against the threshold."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.cli import main
from flowing_puppet_ros.evaluate.output import name_runs
from flowing_puppet_ros.evaluate.video.tracks import measure_misses, read_tracks
from flowing_puppet_ros.image.formats.keypoint_files import read_keypoints

NAMES = ["left_wrist", "right_wrist", "neck"]


def _files(folder: Path, frames: dict[int, list[list[list[float]]]], truth: dict[int, list[list[list[float]]]]) -> None:
    puppets = [
        {"index": index, "puppets": [{"id": "a", "joints": joints} for joints in people]}
        for index, people in frames.items()
    ]
    (folder / "tracks.json").write_text(json.dumps({"joint_names": NAMES, "fps": 10, "frames": puppets}))
    listed = {str(index): people for index, people in truth.items()}
    (folder / "truth.json").write_text(json.dumps({"joint_names": NAMES, "frames": listed}))


def _run(folder: Path, *words: str) -> int:
    """Measure tracks.json and what `words` begin with; flags follow."""
    return main(["evaluate", "joints", str(folder / "tracks.json"), *words, "--truth", str(folder / "truth.json")])


def test_distances_misses_and_unknown_joints(tmp_path: Path) -> None:
    near: list[list[float]] = [[13, 14, 1], [50, 50, 1], [30, 31, 1]]
    far: list[list[float]] = [[500, 500, 1], [510, 500, 1], [500, 510, 1]]
    nan: Any = None
    truth: dict[int, Any] = {
        0: [[[10, 10, 1], [nan, nan, 0], [30, 30, 1]]],
        1: [[[10, 10, 1], [20, 20, 1], [30, 30, 1]]],
        2: [[[505, 500, 1], [510, 500, 1], [500, 510, 1]], [[10, 10, 1], [50, 58, 1], [30, 30, 1]]],
    }
    _files(tmp_path, {0: [far, near], 2: [near, far]}, truth)
    misses = measure_misses(read_tracks(tmp_path / "tracks.json").frames, read_keypoints(tmp_path / "truth.json"))
    assert misses.names == tuple(NAMES[:1] + NAMES[2:] + NAMES[1:2])
    ordered = misses.distance[:, [misses.names.index(name) for name in NAMES]]
    np.testing.assert_allclose(ordered[0], [5, np.nan, 1])
    assert np.isinf(ordered[1]).all()
    np.testing.assert_allclose(ordered[2:], [[5, 0, 0], [5, 8, 1]])
    accuracy = misses.accuracy(np.array([1, 5, 8]))
    np.testing.assert_allclose(accuracy["left_wrist"], [0, 75, 75])
    np.testing.assert_allclose(accuracy["right_wrist"], [100 / 3, 100 / 3, 200 / 3])
    np.testing.assert_allclose(accuracy["all"], [400 / 11, 700 / 11, 800 / 11])


@pytest.mark.slow
def test_the_command_writes_curves_of_several_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    person: list[list[float]] = [[10, 10, 1], [20, 20, 1], [30, 30, 1]]
    _files(tmp_path, {0: [person]}, {0: [[[10, 13, 1], [20, 20, 1], [30, 30, 1]]]})
    (tmp_path / "other").mkdir()
    _files(tmp_path / "other", {5: [person]}, {0: []})
    words = [str(tmp_path / "other" / "tracks.json"), "--most", "8", "--out", str(tmp_path / "out")]
    assert _run(tmp_path, *words, "--json") == 0
    runs = json.loads(capsys.readouterr().out)
    found, nobody = runs[f"{tmp_path.name}/tracks"], runs["other/tracks"]
    assert [found[f"wrists within {t} px, %"] for t in (1, 2, 4, 8)] == [50, 50, 100, 100]
    assert found["wrists, median px"] == 3 and found["jitter, px"] is None
    assert nobody["wrists within 8 px, %"] == 0 and nobody["wrists, median px"] is None
    written = json.loads((tmp_path / "out" / "joints.json").read_text())
    assert written["percent_within"][f"{tmp_path.name}/tracks"]["left_wrist"] == [0, 0, 100, 100, 100, 100, 100, 100]
    png = cv2.imread(str(tmp_path / "out" / "joints-accuracy.png"))
    assert png is not None and png.std() > 10
    svg = (tmp_path / "out" / "joints-accuracy.svg").read_bytes()
    assert b"wrists (other/tracks)" in svg
    assert _run(tmp_path, *words) == 0
    assert svg == (tmp_path / "out" / "joints-accuracy.svg").read_bytes()
    header, first, *_ = capsys.readouterr().out.splitlines()
    assert header.split() == ["figure", f"{tmp_path.name}/tracks", "other/tracks"]
    assert first.split() == ["wrists", "within", "1", "px,", "%", "50", "0"]


def test_jitter_is_of_one_person_in_successive_frames(tmp_path: Path) -> None:
    def at(x: float) -> list[list[float]]:
        return [[x, 0, 1], [x, 5, 1], [x, 9, 1]]

    # Frame 3 is missing: frames 4 to 6 are another run.
    frames = {0: [at(0)], 1: [at(1)], 2: [at(5)], 4: [at(50)], 5: [at(51)], 6: [at(52)]}
    _files(tmp_path, frames, {})
    assert read_tracks(tmp_path / "tracks.json").jitter() == pytest.approx(1.5)


def test_runs_are_told_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert name_runs([Path("x/a.json"), Path("y/b.json")]) == ["a", "b"]
    assert name_runs([Path("x/a.json"), Path("y/a.json")]) == ["x/a", "y/a"]
    assert name_runs([Path("x/a.json"), Path("z/x/a.mcap")]) == ["x/a.json", "z/x/a.mcap"]
    _files(tmp_path, {}, {0: []})
    assert _run(tmp_path, str(tmp_path / "tracks.json")) == 2
    assert "named twice" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("tracks", "flags", "sentence"),
    [
        ("{}", [], "is not a tracks.json"),
        (
            '{"joint_names": ["left_wrist"], "frames": [{"index": 0, "puppets": [{"joints": 3}]}]}',
            [],
            "is not a tracks.json",
        ),
        ('{"joint_names": ["left_ear"], "frames": []}', [], "no joint in common"),
        (None, [], "cannot be read"),
        ("{}", ["--most", "1"], "--most is 1"),
    ],
)
def test_unusable_input_is_named(
    tmp_path: Path, tracks: str | None, flags: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    _files(tmp_path, {}, {0: [[[1, 1, 1], [2, 2, 1], [3, 3, 1]]]})
    path = tmp_path / "tracks.json"
    path.unlink() if tracks is None else path.write_text(tracks)
    assert _run(tmp_path, *flags) == 2
    assert sentence in capsys.readouterr().err
