# SPDX-License-Identifier: Apache-2.0
"""Our own files of people, folders with one file a frame, and what is wrong with them."""

import json
from pathlib import Path
from typing import Any

import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.frame_names import FrameNames
from flowing_puppet_ros.image.formats.keypoint_files import read_keypoints

NAMES = ["left_wrist", "neck"]
PERSON = [[10.0, 20.0, 0.9], [None, None, None]]


def write(path: Path, data: Any) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(data))
    return path


def openpose(x: float) -> dict[str, Any]:
    """Return a frame of OpenPose with one left wrist (number 7 of 25) and a person without points."""
    values = [0.0] * 75
    values[21:24] = [x, 50.0, 0.7]
    return {"people": [{"pose_keypoints_2d": values}, {"pose_keypoints_2d": []}]}


def wrists(people: dict[int, list[Any]]) -> dict[int, list[float]]:
    return {index: [one.select_usable()["left_wrist"][0] for one in found] for index, found in people.items()}


def test_our_own_keypoints_and_their_unknown_points(tmp_path: Path) -> None:
    path = write(tmp_path / "k.json", {"joint_names": NAMES, "frames": {"2": [PERSON], "5": []}})
    people = read_keypoints(path)
    assert list(people) == [2, 5] and people[5] == []
    assert people[2][0].select_usable() == {"left_wrist": (10.0, 20.0, 0.9)}


def test_our_own_keypoints_may_name_images(tmp_path: Path) -> None:
    path = write(tmp_path / "k.json", {"joint_names": NAMES, "frames": {"b.png": [PERSON], "z.png": [PERSON]}})
    frames = FrameNames(files=(Path("a.png"), Path("b.png")), count=2)
    assert wrists(read_keypoints(path, frames)) == {1: [10.0]}


def test_tracks_and_poses_are_read_as_they_are_written(tmp_path: Path) -> None:
    puppets = [{"id": "a1", "joints": PERSON}]
    tracks = {
        "joint_names": NAMES,
        "fps": 30,
        "frames": [{"index": 4, "puppets": puppets}, {"index": 5, "puppets": []}],
    }
    people = read_keypoints(write(tmp_path / "tracks.json", tracks))
    assert {index: len(found) for index, found in people.items()} == {4: 1, 5: 0}
    poses = {"joint_names": NAMES, "frames": [{"index": 0, "path": "/data/b.png", "puppets": puppets}]}
    frames = FrameNames(files=(Path("a.png"), Path("b.png")), count=2)
    assert wrists(read_keypoints(write(tmp_path / "poses.json", poses), frames)) == {1: [10.0]}


def test_a_folder_of_openpose_has_a_frame_a_file(tmp_path: Path) -> None:
    folder = tmp_path / "json"
    for index in (0, 7, 12):
        write(folder / f"walk_{index:012d}_keypoints.json", openpose(100.0 + index))
    write(folder / "settings.json", {"net": 3})
    assert wrists(read_keypoints(folder)) == {0: [100.0], 7: [107.0], 12: [112.0]}
    images = FrameNames(files=(Path("walk_7.png"), Path("walk_0.png")), count=2)
    assert wrists(read_keypoints(folder, images)) == {1: [100.0], 0: [107.0]}, "names before numbers"


def test_a_folder_for_a_folder_of_images_goes_by_name(tmp_path: Path) -> None:
    folder = tmp_path / "json"
    write(folder / "b_keypoints.json", openpose(2.5))
    write(folder / "a_keypoints.json", openpose(100.0))
    frames = FrameNames(files=(Path("a.jpg"), Path("b.jpg"), Path("c.jpg")), count=3)
    assert wrists(read_keypoints(folder, frames)) == {0: [100.0], 1: [2.5]}
    assert wrists(read_keypoints(folder / "b_keypoints.json", frames)) == {1: [2.5]}, "one file of it, by name too"
    for file in folder.iterdir():
        file.rename(file.with_name(file.name.replace("_keypoints", "")))
    assert wrists(read_keypoints(folder, frames)) == {0: [100.0], 1: [2.5]}


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("", "", "has no JSON file; expected is one a frame as OpenPose writes them, NAME_000000000012_keypoints.json"),
        ("a_keypoints.json", '{"people": [{"pose_key', "a_keypoints.json is not a JSON file"),
        ("a_keypoints.json", '{"boxes": []}', 'expected is {"people": [{"pose_keypoints_2d": [x, y, c, ...]}]'),
        ("a_keypoints.json", '{"people": []}', "has no person in any frame"),
    ],
    ids=["empty", "truncated", "other", "nobody"],
)
def test_a_wrong_folder_gets_one_sentence(tmp_path: Path, name: str, text: str, says: str) -> None:
    folder = tmp_path / "json"
    folder.mkdir()
    if name:
        (folder / name).write_text(text)
    frames = FrameNames(files=(Path("a.png"),), count=1)
    with pytest.raises(InputError) as told:
        read_keypoints(folder, frames)
    assert says in str(told.value) and "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        ({"joint_names": NAMES, "frames": {"0": [PERSON[:1]]}}, "frame 0: a person needs 2 entries"),
        ({"joint_names": NAMES, "frames": {"0": [[[10**400, 1, 1], [1, 1, 1]]]}}, "frame 0: a person needs 2 entries"),
        ({"joint_names": NAMES, "frames": {"a.png": [PERSON]}}, "names the image 'a.png', but the frames here have no"),
        (
            {"joint_names": NAMES, "frames": {"a.png": 3}},
            "frame 'a.png' must be an index or an image's name, with a list",
        ),
        ({"joint_names": NAMES, "frames": [{"index": None, "puppets": []}]}, 'frame 0 needs "index" and "puppets"'),
        ({"joint_names": NAMES, "frames": [{"index": 1, "puppets": [[]]}]}, 'frame 0 needs "index" and "puppets"'),
        ({"joint_names": NAMES, "frames": []}, "no person in any frame"),
        ({"joint_names": ["tail"], "frames": {}}, "has no known joint name"),
        ({"joint_names": NAMES}, 'needs "joint_names" and "frames"'),
    ],
)
def test_wrong_files_of_ours_get_one_sentence(tmp_path: Path, data: Any, says: str) -> None:
    with pytest.raises(InputError) as told:
        read_keypoints(write(tmp_path / "k.json", data))
    assert says in str(told.value) and "\n" not in str(told.value)


def test_a_file_that_is_not_there_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.json cannot be read: No such file"):
        read_keypoints(tmp_path / "none.json")
