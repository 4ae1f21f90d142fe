# SPDX-License-Identifier: Apache-2.0
"""Frames by the names that files of keypoints have for them."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.frame_names import FrameNames, Label
from flowing_puppet_ros.image.formats.video_reader import open_frames


def folder(*names: str) -> FrameNames:
    return FrameNames("walk", tuple(Path(name) for name in names), len(names))


VIDEO = FrameNames("walk", count=20)


@pytest.mark.parametrize(
    ("names", "label", "index"),
    [
        (["a.png", "b.png"], "b.png", 1),
        (["a.png", "b.png"], "b.jpg", 1),
        (["a.png", "b.png"], "b", 1),
        (["im_002.png", "im_010.png"], "im_10.jpg", 1),
        (["im_2.png", "im_10.png"], "im_0010", 1),
        (["v1.5.png", "v1.6.png"], "v1.6", 1),
        (["x/a.png", "y/a.png"], "y/a.png", 1),
        (["x/a.png", "y/a.png"], "set\\y\\a.png", 1),
        (["x/a.png", "y/a.png"], "a.png", None),
        (["x/a.png", "x/b.png"], "elsewhere/b.png", 1),
        (["000000000009.jpg", "000000000139.jpg"], "139", 1),
        (["COCO_val_000000000009.jpg", "COCO_val_000000000139.jpg"], "139", 1),
        (["frame1.png", "frame2.png"], "2", 1),
        (["frame5.png", "frame6.png"], "1", 1),
        (["street.png", "square.png"], "1.jpg", 1),
        (["street.png", "square.png"], "film_000000000001", 1),
    ],
)
def test_names_find_their_image(names: list[str], label: str, index: int | None) -> None:
    if index is None:
        with pytest.raises(InputError, match="several folders"):
            folder(*names).match([label], "k.json")
        return
    assert folder(*names).match([label], "k.json") == {label: [index]}


def test_a_frame_that_is_given_twice_has_its_people_twice() -> None:
    assert folder("a.png", "b.png", "a.png").match(["a.png"], "k.json") == {"a.png": [0, 2]}


def test_the_better_rule_goes_first_and_other_images_are_absent() -> None:
    labels: list[Label] = ["im_1.jpg", "im_01.png", "other.png"]
    assert folder("im_01.png", "im_2.png").match(labels, "k.json") == {"im_01.png": [0]}


def test_numbers_are_those_of_names_if_all_are_there_and_else_indices() -> None:
    frames = folder("f_1.png", "f_2.png", "f_3.png")
    assert frames.match(["1.jpg", "3.jpg"], "k.json") == {"1.jpg": [0], "3.jpg": [2]}
    assert frames.match(["0.jpg", "2.jpg"], "k.json") == {"0.jpg": [0], "2.jpg": [2]}, "counted from 0 in a video"
    assert frames.match(["2", "4000"], "k.json") == {"2": [1]}, "a few images of a large set"


def test_frames_of_a_video_are_numbered() -> None:
    assert VIDEO.match(["walk_000000000012", "walk_000000000007"], "k") == {
        "walk_000000000012": [12],
        "walk_000000000007": [7],
    }
    assert VIDEO.match([3, "0004.jpg"], "k") == {3: [3], "0004.jpg": [4]}
    assert VIDEO.match(["walk_01", "run_02"], "k") == {"walk_01": [1]}, "the video's own frames of several videos"
    assert VIDEO.match(["frames/walk/0002.png", "frames/run/0003.png"], "k") == {"frames/walk/0002.png": [2]}
    with pytest.raises(InputError, match="several videos"):
        VIDEO.match(["run_02", "jump_02"], "k")
    with pytest.raises(InputError, match="give the folder of images"):
        VIDEO.match(["street.jpg"], "k")


@pytest.mark.parametrize("labels", [["cat.png", "dog.png"], ["im_7.png"], ["900"], ["0000.jpg"]])
def test_images_of_other_names_are_one_sentence(labels: list[Label]) -> None:
    with pytest.raises(InputError, match=r"k\.json names images such as .* but the frames are called 'im_1\.png'"):
        folder("im_1.png", "im_2.png").match(labels, "k.json")


def test_sizes_are_those_of_the_frames(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((30, 40, 3), np.uint8))
    cv2.imwrite(str(tmp_path / "b.png"), np.zeros((50, 60, 3), np.uint8))
    (tmp_path / "c.png").write_bytes(b"broken")
    read_size = FrameNames.of(open_frames(tmp_path)).read_size
    assert read_size is not None
    assert [read_size(index) for index in range(4)] == [(40, 30), (60, 50), None, None]
