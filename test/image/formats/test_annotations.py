# SPDX-License-Identifier: Apache-2.0
"""Both layouts of annotations, and what is said of broken ones."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.annotations import HIDDEN_CONFIDENCE, Annotations, source_video

NAMES = ["neck", "belly"]


def write_video(path: Path, frames: int = 6) -> None:
    """A video whose frames get brighter."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (32, 24))
    for index in range(frames):
        writer.write(np.full((24, 32, 3), 20 * index, np.uint8))
    writer.release()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder as the annotation tool leaves it."""
    (tmp_path / "street").mkdir()
    red = np.zeros((24, 32, 3), np.uint8)
    red[:, :, 2] = 255
    cv2.imwrite(str(tmp_path / "street" / "a#1b.png"), red)
    write_video(tmp_path / "walk.avi")
    person = {"joints": [[3, 4, 1], [5.5, 6, 0]], "gender": "female", "view": "back"}
    images = {
        "walk.avi#4": [{"joints": [[1, 2, 1], [None, None, 0]]}],
        "walk.avi#1": [],
        "street/a#1b.png": [person, person],
    }
    (tmp_path / "annotations.json").write_text(json.dumps({"joint_names": NAMES, "images": images}))
    return tmp_path


def test_folder_of_the_annotation_tool(folder: Path) -> None:
    annotations = Annotations.load(folder / "annotations.json")
    assert len(annotations) == 3
    image, empty, frame = annotations.read_frames()
    assert (image.file, image.index, len(image.people)) == ("street/a#1b.png", 0, 2)
    assert tuple(image.image[0, 0]) == (255, 0, 0), "RGB"
    assert (image.people[0].gender, image.people[0].view) == ("female", "back")
    np.testing.assert_array_equal(image.people[0].keypoints.confidence, [1.0, HIDDEN_CONFIDENCE])
    np.testing.assert_array_equal(image.people[0].keypoints.xy, [[3, 4], [5.5, 6]])
    assert (empty.index, empty.people) == (1, ())
    assert (frame.index, frame.people[0].gender, frame.people[0].view) == (4, "neutral", None)
    assert abs(int(frame.image.mean()) - 80) < 4
    np.testing.assert_array_equal(frame.people[0].keypoints.confidence, [1.0, 0.0])


def test_joints_a_clip(folder: Path) -> None:
    write_video(folder / "B_clap_u_cm_np1_fr_goo_0.avi")
    rows = [[[1, 2, 0.25], [3, 4, 0.0]], None, [[1, 2, 1.0], [3, 4, 1.0]], [[1, 2, 1.0], [3, 4, 1.0]]]
    clips = {"walk.avi": {"exact": True, "joints": [[[7, 8], [9, 1]]]}, "B_clap_u_cm_np1_fr_goo_0.avi": rows}
    path = folder / "joints.json"
    path.write_text(json.dumps({"joint_names": NAMES, "clips": clips}))
    annotations = Annotations.load(path, folder)
    assert [(f.file[0], f.index) for f in annotations.read_frames()] == [("B", 0), ("B", 2), ("B", 3), ("w", 0)]
    assert [(f.file[0], f.index) for f in annotations.read_frames(2)] == [("B", 0), ("B", 3), ("w", 0)]
    first = next(iter(annotations.read_frames()))
    np.testing.assert_array_equal(first.people[0].keypoints.confidence, [0.25, 0.0])
    assert Annotations.load(path).folder == folder / "clips"


def test_clips_of_one_source_are_left_out_together() -> None:
    names = ["A_b_clap_u_nm_np1_fr_med_0.avi", "A_b_shoot_bow_u_cm_np1_ri_goo_12.avi", "A_clap_u_nm_np1_fr_med_0.avi"]
    assert [source_video(name) for name in names] == ["A_b", "A_b", "A"]
    assert source_video("holiday/walk.mp4") == "holiday/walk"
    everything = Annotations(Path(), {name: {} for name in names})
    assert list(everything.exclude_sources_of(Annotations(Path(), {names[0]: {}})).people) == [names[2]]


@pytest.mark.parametrize(
    "text",
    [
        *("", "[]", "{}", '{"joint_names": ["neck"]}', '{"joint_names": ["neck"], "clips": [1]}'),
        '{"joint_names": ["neck"], "images": {"a.png": [{}]}}',
        '{"joint_names": ["neck"], "images": {"a.png": [{"joints": [[1, 2], [3, 4]]}]}}',
        '{"joint_names": ["neck"], "clips": {"a.avi": [[["x", 2]]]}}',
    ],
)
def test_broken_files_are_one_sentence(tmp_path: Path, text: str) -> None:
    path = tmp_path / "broken.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"broken\.json|keypoint names need as many"):
        Annotations.load(path)


def test_missing_files_and_frames_are_named(folder: Path) -> None:
    with pytest.raises(InputError, match=r"none\.json cannot be read"):
        Annotations.load(folder / "none.json")
    for key, message in (("walk.avi#99", "has no frame 99"), ("gone.png", r"gone\.png does not exist")):
        path = folder / "other.json"
        path.write_text(json.dumps({"joint_names": NAMES, "images": {key: []}}))
        with pytest.raises(InputError, match=message):
            list(Annotations.load(path).read_frames())
