# SPDX-License-Identifier: Apache-2.0
"""Frames of videos and folders, in order, and one sentence for what cannot be read."""

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.video_reader import open_frames


def write_video(path: Path, count: int) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, (64, 48))  # type: ignore[attr-defined]
    for k in range(count):
        writer.write(np.full((48, 64, 3), (10 * k, 0, 200), np.uint8))
    writer.release()


def test_frames_of_a_video_come_in_order_as_rgb(tmp_path: Path) -> None:
    write_video(tmp_path / "a.avi", 5)
    source = open_frames(tmp_path / "a.avi")
    frames = list(source)
    assert source.fps == 25.0
    assert source.count == 5
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4]
    assert [frame.stamp_ns for frame in frames] == [0, 40_000_000, 80_000_000, 120_000_000, 160_000_000]
    np.testing.assert_allclose(frames[4].image[20, 30], [200, 0, 40], atol=6)
    assert frames[0].path == ""


def test_images_of_a_folder_come_in_natural_order(tmp_path: Path) -> None:
    for k in (10, 2, 1):
        cv2.imwrite(str(tmp_path / f"frame{k}.png"), np.full((20, 30, 3), (k, 0, 99), np.uint8))
    (tmp_path / "notes.txt").write_text("none")
    frames = list(open_frames(tmp_path))
    assert [Path(frame.path).name for frame in frames] == ["frame1.png", "frame2.png", "frame10.png"]
    assert frames[2].image[0, 0].tolist() == [99, 0, 10]
    assert len(list(open_frames(tmp_path / "frame2.png"))) == 1


@pytest.mark.parametrize("name", ["missing.mp4", "text.mp4", "empty.mp4", "folder", "broken"])
def test_what_cannot_be_read_is_named(name: str, tmp_path: Path) -> None:
    (tmp_path / "text.mp4").write_text("no video")
    (tmp_path / "empty.mp4").touch()
    (tmp_path / "folder").mkdir()
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "a.png").write_bytes(b"\x89PNG")
    with pytest.raises(InputError, match=name):
        list(open_frames(tmp_path / name))


def test_a_truncated_video_gives_the_frames_it_has(tmp_path: Path) -> None:
    write_video(tmp_path / "a.avi", 40)
    data = (tmp_path / "a.avi").read_bytes()
    (tmp_path / "b.avi").write_bytes(data[: len(data) // 2])
    assert 0 < len(list(open_frames(tmp_path / "b.avi"))) < 40


def test_broken_frames_are_told_of_and_left_out_when_somebody_listens(tmp_path: Path) -> None:
    for k in range(4):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((20, 30, 3), k, np.uint8))
    (tmp_path / "2.png").write_bytes(b"\x89PNG")
    said: list[str] = []
    assert [frame.index for frame in open_frames(tmp_path, said.append)] == [0, 1, 3]
    assert len(said) == 1
    assert "2.png is not a readable image" in said[0]
    with pytest.raises(InputError, match=r"2\.png"):
        list(open_frames(tmp_path))


def test_a_video_goes_on_after_frames_that_cannot_be_decoded(tmp_path: Path) -> None:
    write_video(tmp_path / "a.avi", 30)
    data = bytearray((tmp_path / "a.avi").read_bytes())
    starts = [at for at in range(len(data)) if data[at : at + 4] == b"00dc"][:30]
    for start, end in pairwise(starts[10:13]):
        data[start + 8 : end] = bytes(end - start - 8)
    (tmp_path / "b.avi").write_bytes(data)
    said: list[str] = []
    frames = list(open_frames(tmp_path / "b.avi", said.append))
    assert frames[-1].index >= 27
    assert abs(int(frames[-1].image[0, 0, 2]) - (290 - 256)) < 6, "the last image is the last"
    assert len(frames) == 30 or said
