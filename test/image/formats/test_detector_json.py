# SPDX-License-Identifier: Apache-2.0
"""One person, as each detector would write them, and one sentence for each way in which a file can be wrong."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.frame_names import FrameNames
from flowing_puppet_ros.image.formats.keypoint_files import read_keypoints
from flowing_puppet_ros.image.formats.keypoints import Keypoints

WIDTH, HEIGHT = 640, 480
# Places in the image, and the numbers of these points as each detector's documentation has them.
PLACES = {
    "nose": (320.0, 60.0),
    "left_eye": (330.0, 50.0),
    "left_shoulder": (370.0, 120.0),
    "right_shoulder": (270.0, 122.0),
    "left_wrist": (410.0, 260.0),
    "right_wrist": (230.0, 262.0),
    "right_knee": (290.0, 400.0),
}
COCO = dict(zip(PLACES, (0, 1, 5, 6, 9, 10, 14), strict=True))
OPENPOSE_18 = dict(zip(PLACES, (0, 15, 5, 2, 7, 4, 9), strict=True))
OPENPOSE_25 = dict(zip(PLACES, (0, 16, 5, 2, 7, 4, 10), strict=True))
MEDIAPIPE = dict(zip(PLACES, (0, 2, 11, 12, 15, 16, 26), strict=True))


def flat(numbers: Mapping[str, int], count: int, confidence: float = 0.9) -> list[float]:
    """Return x, y, confidence of `count` points, those of PLACES at their numbers and zeros elsewhere."""
    values = [0.0] * (3 * count)
    for name, number in numbers.items():
        values[3 * number : 3 * number + 3] = [*PLACES[name], confidence]
    return values


def landmarks(scale: tuple[float, float] = (1.0, 1.0)) -> list[dict[str, float]]:
    """Return MediaPipe's 33 landmarks, those of PLACES and others that it is not sure of at all."""
    points = [{"x": 0.5, "y": 0.5, "z": -0.1, "visibility": 0.0} for _ in range(33)]
    for name, number in MEDIAPIPE.items():
        x, y = PLACES[name]
        points[number] |= {"x": x / scale[0], "y": y / scale[1], "visibility": 0.9}
    return points


def write(path: Path, data: Any) -> Path:
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return path


def only(people: Mapping[int, Sequence[Keypoints]]) -> Keypoints:
    """Return the person of frame 0, the only one."""
    assert list(people) == [0]
    (person,) = people[0]
    return person


NORMALISED = landmarks((WIDTH, HEIGHT))
FORMS: dict[str, Any] = {
    "COCO": {
        "images": [{"id": 7, "file_name": "000000000000.jpg"}],
        "annotations": [{"id": 1, "image_id": 7, "category_id": 1, "keypoints": flat(COCO, 17)}],
    },
    "COCO results": [{"image_id": 0, "category_id": 1, "keypoints": flat(COCO, 17), "score": 0.8}],
    "AlphaPose": [{"image_id": "0.jpg", "keypoints": flat(COCO, 17), "score": 2.9, "idx": [0.0]}],
    "AlphaPose Halpe-26": [{"image_id": "0.jpg", "keypoints": flat(COCO, 26), "score": 2.9}],
    "AlphaPose Halpe-136": [{"image_id": "0.jpg", "keypoints": flat(COCO, 136), "score": 2.9}],
    "AlphaPose by image": {"0.jpg": {"version": "AlphaPose", "bodies": [{"joints": flat(OPENPOSE_18, 18)}]}},
    "whole body": [{"image_id": 0, "keypoints": flat(COCO, 133)}],
    "OpenPose": {"version": 1.3, "people": [{"person_id": [-1], "pose_keypoints_2d": flat(OPENPOSE_25, 25)}]},
    "OpenPose 18": {"people": [{"pose_keypoints_2d": flat(OPENPOSE_18, 18)}]},
    "OpenPose list": [{"people": [{"pose_keypoints_2d": flat(OPENPOSE_25, 25)}]}],
    "MediaPipe": landmarks(),
    "MediaPipe frames": {"fps": 30, "frames": [{"frame": 0, "pose_landmarks": landmarks()}]},
    "MediaPipe people": [{"poseLandmarks": [landmarks()], "poseWorldLandmarks": [NORMALISED]}],
    "MediaPipe by index": {"0": landmarks()},
    "MediaPipe rows": [[[*point.values()] for point in landmarks()]],
    "MediaPipe names": {name.upper(): {"x": x, "y": y, "visibility": 0.9} for name, (x, y) in PLACES.items()},
    "normalised": {"width": WIDTH, "height": HEIGHT, "frames": [{"landmarks": NORMALISED}]},
    "normalised in the frame": [{"image_width": WIDTH, "image_height": HEIGHT, "landmarks": NORMALISED}],
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_has_the_same_person(tmp_path: Path, form: str) -> None:
    person = only(read_keypoints(write(tmp_path / "file.json", FORMS[form])))
    found = person.select_usable()
    assert set(found) == set(PLACES), "points that were not found are absent, not in the corner"
    for name, place in PLACES.items():
        assert found[name] == pytest.approx((*place, 0.9))


def test_names_of_the_file_go_before_the_order(tmp_path: Path) -> None:
    names = ["r_wrist", "l_wrist", "top_head"]
    annotation = {"image_id": 0, "category_id": 3, "keypoints": [10, 20, 2, 30, 40, 1, 0, 0, 0]}
    data = {"categories": [{"id": 3, "name": "person", "keypoints": names}], "annotations": [annotation]}
    found = only(read_keypoints(write(tmp_path / "coco.json", data))).select_usable()
    assert {name: point[:2] for name, point in found.items()} == {"right_wrist": (10, 20), "left_wrist": (30, 40)}


@pytest.mark.parametrize(
    ("given", "kept"),
    [((2, 1), (1.0, 0.2)), ((1, 1), (1.0, 1.0)), ((1.7, 0.4), (1.0, 0.4)), ((5.0, -1.0), (1.0, None))],
    ids=["COCO's visible and hidden", "ones are scores", "AlphaPose over one", "below zero is absent"],
)
def test_confidences_of_every_scale_become_shares(
    tmp_path: Path, given: tuple[float, float], kept: tuple[float, float | None]
) -> None:
    values = [0.0] * 51
    for index, confidence in zip((9, 10), given, strict=True):
        values[3 * index : 3 * index + 3] = [100.0 + index, 50.0, confidence]
    data = [{"image_id": 0, "keypoints": values}]
    found = only(read_keypoints(write(tmp_path / "results.json", data))).select_usable()
    assert found["left_wrist"][2] == pytest.approx(kept[0])
    assert found.get("right_wrist", (0, 0, None))[2] == (None if kept[1] is None else pytest.approx(kept[1]))


def test_crowds_doubtful_results_and_people_without_points_are_left_out(tmp_path: Path) -> None:
    entry = {"image_id": 1, "keypoints": flat(COCO, 17)}
    data: dict[str, Any] = {
        "images": [{"id": 1, "file_name": "0.png"}, {"id": 2, "file_name": "3.png"}],
        "annotations": [entry, entry | {"iscrowd": 1}, entry | {"keypoints": [0] * 51}, {"image_id": 1, "bbox": [1]}],
    }
    people = read_keypoints(write(tmp_path / "coco.json", data))
    assert {index: len(found) for index, found in people.items()} == {0: 1, 3: 0}, "nobody was found in image 3"
    results = [entry | {"image_id": 4, "score": score} for score in (0.9, 0.05, 3.1)]
    assert {i: len(found) for i, found in read_keypoints(write(tmp_path / "r.json", results)).items()} == {4: 2}


def test_halpe_says_head_to_the_top_of_the_head(tmp_path: Path) -> None:
    names = [f"point {k}" for k in range(17)] + ["head", "neck", "hip"] + [f"toe {k}" for k in range(6)]
    values = [0.0] * 78
    values[51:54] = [300.0, 20.0, 0.8]
    data = {
        "categories": [{"id": 1, "keypoints": names}],
        "annotations": [{"image_id": 0, "category_id": 1, "keypoints": values}],
    }
    assert set(only(read_keypoints(write(tmp_path / "h.json", data))).select_usable()) == {"head_top"}


def test_one_unknown_number_makes_one_point_unknown(tmp_path: Path) -> None:
    values: list[Any] = flat(COCO, 17)
    values[3 * COCO["left_wrist"]] = float("nan")
    values[3 * COCO["right_wrist"] + 1] = None
    found = only(read_keypoints(write(tmp_path / "r.json", [{"image_id": 0, "keypoints": values}]))).select_usable()
    assert set(PLACES) - set(found) == {"left_wrist", "right_wrist"}


NOT_A_NUMBER = [{"image_id": 0, "keypoints": [float("nan")] * 51}]
METRES = [{"landmarks": [{"x": (k % 5 - 2) / 4, "y": (k % 7 - 3) / 4, "visibility": 1} for k in range(33)]}]
WRONG: dict[str, tuple[Any, str]] = {
    "truncated": (json.dumps(FORMS["COCO"])[:150], "is not a JSON file"),
    "nothing": ({}, 'expected is one of {"joint_names"'),
    "number": (3, '"pose_keypoints_2d": [x, y, c, ...]'),
    "other": ({"boxes": [[1, 2, 3, 4]]}, '[{"image_id", "keypoints": [x, y, score, ...]}, ...]'),
    "frames of something": ({"frames": [{"boxes": []}]}, "has none of the forms"),
    "nested": ("[" * 900 + "]" * 900, "has none of the forms"),
    "no frames": ([], "has none of the forms"),
    "nobody": ([[], []], "no person in any frame"),
    "count": ([{"image_id": 0, "keypoints": [1.0] * 48}], "entry 0: 48 keypoint values; give x, y and confidence of"),
    "odd count": ({"people": [{"pose_keypoints_2d": [1.0] * 52}]}, "person 0: 52 keypoint values"),
    "text": ([{"image_id": 0, "keypoints": ["a"] * 51}], "must be numbers"),
    "long number": ('[{"image_id": 0, "keypoints": [' + "9" * 400 + "]}]", "must be numbers"),
    "no image": ([*FORMS["AlphaPose"], {"keypoints": []}], 'entry 1 is incomplete; results need "image_id"'),
    "no keypoints": ({"people": [{"box": []}]}, 'needs {"people": [{"pose_keypoints_2d": [x, y, c, ...]}]'),
    "images of nothing": ({"images": [{"file": 1}], "annotations": []}, 'COCO needs "images": [{"id", "file_name"}]'),
    "annotations of nothing": ({"annotations": 3}, "COCO needs"),
    "few landmarks": ([landmarks()[:20]], "20 landmarks without names; MediaPipe's have 33"),
    "landmark without place": ([[*landmarks()[:32], {"z": 1}]], "has a landmark without place"),
    "landmark of lists": ([[{"x": [1], "y": [2], "visibility": [1]}] * 33], "is a list; each must be one number"),
    "long index": ({"9" * 5000: landmarks()}, "the frames here have no names"),
    "other frame": ([landmarks(), {"boxes": 1}], "frame 1 is of another form than those before"),
    "NaN": (NOT_A_NUMBER, "no person in any frame"),
    "metres": (METRES, "coordinates around 0, as of landmarks in metres"),
    "no size": ([{"landmarks": NORMALISED}], 'add "width" and "height" in pixels'),
    "no size in OpenPose": (
        {"people": [{"pose_keypoints_2d": [value / 640 for value in flat(OPENPOSE_25, 25)]}]},
        "coordinates from 0 to 1",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_file_gets_one_sentence_that_shows_the_form(tmp_path: Path, case: str) -> None:
    data, says = WRONG[case]
    with pytest.raises(InputError) as told:
        read_keypoints(write(tmp_path / "file.json", data))
    text = str(told.value)
    assert text.startswith(str(tmp_path / "file.json")) and says in text and "\n" not in text


def test_sizes_may_come_from_the_frames(tmp_path: Path) -> None:
    path = write(tmp_path / "file.json", [[NORMALISED], {}, None, {"landmarks": NORMALISED}])

    def read_size(index: int) -> tuple[int, int]:
        return WIDTH, HEIGHT * (1 + index)

    files = tuple(Path(f"{k}.png") for k in range(4))
    people = read_keypoints(path, FrameNames(files=files, count=4, read_size=read_size))
    assert [len(people[index]) for index in range(4)] == [1, 0, 0, 1], "looked at without finding anybody"
    wrists = [people[index][0].select_usable()["left_wrist"] for index in (0, 3)]
    assert wrists[0][:2] == pytest.approx(PLACES["left_wrist"])
    assert wrists[1][:2] == pytest.approx((PLACES["left_wrist"][0], 4 * PLACES["left_wrist"][1]))
