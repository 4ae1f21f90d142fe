# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet evaluate joints`: accuracy of 2D joints against the threshold."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.cli import main
from flowing_puppet_ros.evaluate.tracks import joint_misses, read_tracks
from flowing_puppet_ros.image.tracks import read_keypoints

NAMES = ["left_wrist", "right_wrist", "neck"]


def _files(folder: Path, frames: dict[int, list[list[list[float]]]], truth: dict[int, list[list[list[float]]]]) -> None:
    puppets = [
        {"index": index, "puppets": [{"id": "a", "joints": joints} for joints in people]}
        for index, people in frames.items()
    ]
    (folder / "tracks.json").write_text(json.dumps({"joint_names": NAMES, "fps": 10, "frames": puppets}))
    listed = {str(index): people for index, people in truth.items()}
    (folder / "truth.json").write_text(json.dumps({"joint_names": NAMES, "frames": listed}))


def _run(folder: Path, *flags: str) -> int:
    return main(["evaluate", "joints", str(folder / "tracks.json"), "--truth", str(folder / "truth.json"), *flags])


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
    misses = joint_misses(read_tracks(tmp_path / "tracks.json"), read_keypoints(tmp_path / "truth.json"))
    assert misses.names == tuple(NAMES[:1] + NAMES[2:] + NAMES[1:2])
    ordered = misses.distance[:, [misses.names.index(name) for name in NAMES]]
    np.testing.assert_allclose(ordered[0], [5, np.nan, 1])
    assert np.isinf(ordered[1]).all()
    np.testing.assert_allclose(ordered[2:], [[5, 0, 0], [5, 8, 1]])
    accuracy = misses.accuracy(np.array([1, 5, 8]))
    np.testing.assert_allclose(accuracy["left_wrist"], [0, 75, 75])
    np.testing.assert_allclose(accuracy["right_wrist"], [100 / 3, 100 / 3, 200 / 3])
    np.testing.assert_allclose(accuracy["all"], [400 / 11, 700 / 11, 800 / 11])


def test_the_command_writes_curves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    person: list[list[float]] = [[10, 10, 1], [20, 20, 1], [30, 30, 1]]
    _files(tmp_path, {0: [person]}, {0: [[[10, 13, 1], [20, 20, 1], [30, 30, 1]]]})
    assert _run(tmp_path, "--most", "8", "--json", "--out", str(tmp_path / "out")) == 0
    figures = json.loads(capsys.readouterr().out)
    assert [figures["left_wrist"][f"{t}_px"] for t in (1, 2, 4, 8)] == [0, 0, 100, 100]
    written = json.loads((tmp_path / "out" / "joints.json").read_text())
    assert written["percent_within"]["left_wrist"] == [0, 0, 100, 100, 100, 100, 100, 100]
    assert "<svg" in (tmp_path / "out" / "joints.html").read_text()


@pytest.mark.parametrize(
    ("tracks", "flags", "sentence"),
    [
        ("{}", [], "is no tracks.json"),
        (
            '{"joint_names": ["left_wrist"], "frames": [{"index": 0, "puppets": [{"joints": 3}]}]}',
            [],
            "is no tracks.json",
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
