# SPDX-License-Identifier: Apache-2.0
"""Overlay videos: frame and flow beside each other, puppets on both; they play back; bad names are one sentence."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.draw.overlay import DrawnPuppet
from flowing_puppet_ros.draw.overlay_video import check_overlay, read_drawn_tracks, write_overlay
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.tracks_json import write_tracks

SQUARE = np.array([[30.0, 20.0], [60.0, 20.0], [60.0, 50.0], [30.0, 50.0]])


def textured(shift: int, size: tuple[int, int] = (96, 72)) -> np.ndarray:
    rng = np.random.default_rng(0)
    large = cv2.resize(rng.integers(0, 256, (12, 16, 3)).astype(np.uint8), (160, 120), interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(large[10 : 10 + size[1], 20 - shift : 20 - shift + size[0]])


def puppet(shift: float) -> DrawnPuppet:
    return DrawnPuppet(
        "a1", ("neck",), np.array([[45.0 + shift, 30.0]]), np.ones(1), ("torso",), (SQUARE + shift,), (0,)
    )


def played(path: Path) -> list[np.ndarray]:
    capture = cv2.VideoCapture(str(path))
    frames: list[np.ndarray] = []
    while True:
        read, frame = capture.read()
        if not read:
            return frames
        frames.append(frame[..., ::-1])


@pytest.mark.parametrize("name", ["o.mp4", "o.avi"])
def test_frames_and_flow_play_back_beside_each_other(name: str, tmp_path: Path) -> None:
    images = [(k, textured(3 * k)) for k in range(4)]
    count = write_overlay(tmp_path / "new" / name, images, [(k, [puppet(3.0 * k)]) for k in range(4)], 25.0)
    frames = played(tmp_path / "new" / name)
    assert count == len(frames) == 4
    assert frames[0].shape == (72, 192, 3)
    plain = np.abs(frames[0][60:, :90].astype(float) - images[0][1][60:, :90]).mean()
    assert plain < 25, "away from the puppet the frame is as it was"
    flow = frames[0][8:16, 96 + 70 : 96 + 90].astype(float).mean(axis=(0, 1))
    assert flow[0] > flow[1] + 30, "motion to the right is red"
    assert frames[0][20:52, 96 + 28 : 96 + 62].min() < 60, "the outline on the flow is black"
    assert frames[-1][8:16, 96 + 70 : 96 + 90].mean() < 30, "the last frame has no flow"


def test_frames_of_other_sizes_or_without_tracks_are_fitted_in(tmp_path: Path) -> None:
    images = [(0, textured(0)), (2, textured(0, (60, 72))), (3, textured(3, (96, 40)))]
    assert write_overlay(tmp_path / "o.avi", images, [(1, [puppet(0.0)]), (3, [puppet(0.0)])], 25.0) == 3
    assert {frame.shape for frame in played(tmp_path / "o.avi")} == {(72, 192, 3)}
    assert write_overlay(tmp_path / "none.avi", [], [], 25.0) == 0


def test_tracks_are_read_line_by_line(tmp_path: Path) -> None:
    entry = {
        "id": "a1",
        "joints": [[1.0, 2.0, 0.5], [None, None, 0.0]],
        "parts": [
            {"name": "torso", "contour": SQUARE.tolist(), "depth": 1},
            {"name": "head", "contour": [], "depth": 0},
        ],
    }
    frames = [{"index": 0, "puppets": []}, {"index": 3, "puppets": [entry]}]
    write_tracks(tmp_path / "t.json", ("neck", "face"), 30.0, frames)
    assert json.loads((tmp_path / "t.json").read_text())["frames"] == frames
    (first, nobody), (second, (drawn,)) = read_drawn_tracks(tmp_path / "t.json")
    assert (first, nobody, second) == (0, [], 3)
    assert drawn.order == (1, 0)
    assert np.isnan(drawn.joints[1]).all()


def test_other_kinds_of_files_are_refused() -> None:
    with pytest.raises(InputError, match=r"must end in \.mp4"):
        check_overlay(Path("o.gif"))
