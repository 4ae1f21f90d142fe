# SPDX-License-Identifier: Apache-2.0
"""PCP against sticks that were moved by known amounts, and the forms of truth."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.image.pcp import PosedSticks, Tally, check_parts, match_people
from flowing_puppet_ros.evaluate.image.pcp_truth import open_true_images, read_stick_truth
from flowing_puppet_ros.evaluate.people import Unmatched
from flowing_puppet_ros.image.formats.stickmen import STICKS, sticks_from_joints, write_sticks
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

MODEL = DeformableStructures.load()
TRUTH = sticks_from_joints(MODEL.joint_names, MODEL.likely_puppet().joints * 150 + 200)
LENGTH = np.linalg.norm(TRUTH[:, 1] - TRUTH[:, 0], axis=1)


def answer(sticks: np.ndarray, *others: np.ndarray) -> PosedSticks:
    return PosedSticks(sticks, np.stack([sticks, *others]))


def test_the_truth_itself_is_correct_either_way_round() -> None:
    for sticks in (TRUTH, TRUTH[:, ::-1]):
        strict, loose = check_parts(sticks, TRUTH)
        assert strict.all() and loose.all()


@given(st.integers(0, 5), st.floats(0, 2 * np.pi), st.floats(0, 0.9))
def test_one_end_off_counts_strictly_to_half_the_length_and_loosely_to_the_whole(
    part: int, angle: float, share: float
) -> None:
    moved = TRUTH.copy()
    # Sideways or outwards, so that turning the stick round never fits better.
    axis = (TRUTH[part, 1] - TRUTH[part, 0]) / LENGTH[part]
    side = np.array([-axis[1], axis[0]])
    moved[part, 1] += share * LENGTH[part] * (abs(np.cos(angle)) * axis + np.sin(angle) * side)
    strict, loose = check_parts(moved, TRUTH)
    assert strict[part] == (share <= 0.5) or abs(share - 0.5) < 1e-6
    assert loose[part]
    assert np.delete(strict, part).all()


def test_strict_is_never_kinder_than_loose() -> None:
    rng = np.random.default_rng(0)
    kinder = 0
    for _ in range(200):
        strict, loose = check_parts(TRUTH + rng.normal(0, 20, TRUTH.shape), TRUTH)
        assert not (strict & ~loose).any()
        kinder += int((loose & ~strict).sum())
    assert kinder > 20


def test_unknown_estimates_are_wrong_and_unknown_truth_is_left_out() -> None:
    unknown = TRUTH.copy()
    unknown[STICKS.index("left_lower_arm"), 1] = np.nan
    strict, _ = check_parts(unknown, TRUTH)
    assert strict.sum() == 5
    tally = Tally()
    tally.add([answer(TRUTH)], [unknown])
    figures = tally.summarise()
    assert figures["strict lower arms"] == 100 and tally.known.sum() == 5
    assert figures["wrists within 20 px"] == 100 and tally.ends.tolist() == [2, 1]


def test_pck_and_oks_of_arms_moved_by_a_known_distance() -> None:
    torso, head = LENGTH[STICKS.index("torso")], LENGTH[STICKS.index("head")]
    for share, length, name in ((0.2, torso, "PCK@0.2, %"), (0.5, head, "PCKh@0.5, %")):
        for factor, expected in ((0.99, 100.0), (1.01, 0.0)):
            tally = Tally()
            tally.add([answer(TRUTH + np.array([factor * share * length, 0.0]))], [TRUTH])
            assert tally.summarise()[name] == expected
    arms = TRUTH[1:5].reshape(-1, 2)
    # COCO's deviations of shoulders, elbows and wrists; the person's area is estimated from all ends of sticks.
    sides = np.ptp(TRUTH.reshape(-1, 2), axis=0)
    area = 0.53 * np.prod(sides + 0.1 * sides.max())
    assert len(arms) == 8
    for distance in (5.0, 30.0, 45.0):
        oks = np.mean([np.exp(-(distance**2) / (2 * area * (2 * sigma) ** 2)) for sigma in (0.079, 0.072, 0.062)])
        tally = Tally()
        tally.add([answer(TRUTH + np.array([distance, 0.0]))], [TRUTH])
        assert tally.summarise()["OKS AP, %"] == 10 * sum(oks >= least for least in np.linspace(0.5, 0.95, 10))


@pytest.mark.parametrize(("unmatched", "expected"), [("wrong", 50.0), ("unknown", 100.0)])
def test_a_score_ranks_people_and_strangers_may_be_unknown(unmatched: Unmatched, expected: float) -> None:
    ghost = PosedSticks(TRUTH + 900, (TRUTH + 900)[None], 0.9)
    right = PosedSticks(TRUTH, TRUTH[None], 0.5)
    tally = Tally(unmatched=unmatched)
    tally.add([ghost, right], [TRUTH])
    assert tally.summarise()["OKS AP, %"] == expected


def test_people_are_matched_by_place_and_strangers_are_not_found() -> None:
    here, there, far = (answer(TRUTH + shift) for shift in (0.0, 300.0, 900.0))
    assert match_people([there, far, here], [TRUTH, TRUTH + 300]) == [here, there]
    assert match_people([far], [TRUTH]) == [None]
    assert match_people([], [TRUTH, TRUTH]) == [None, None]
    tally = Tally()
    tally.add([far], [TRUTH])
    tally.add([here], [TRUTH])
    assert tally.summarise()["found"] == 50 and tally.summarise()["loose total"] == 50


def test_wrists_of_the_best_solution() -> None:
    wrong = TRUTH.copy()
    wrong[[STICKS.index("left_lower_arm"), STICKS.index("right_lower_arm")], 1] += 60
    tally = Tally(pixels=10)
    tally.add([answer(wrong, TRUTH)], [TRUTH])
    figures = tally.summarise()
    assert figures["wrists within 10 px"] == 0 and figures["wrists of the best solution"] == 100
    assert figures["elbows within 10 px"] == 100


def picture(path: Path, value: int) -> None:
    assert cv2.imwrite(str(path), np.full((20, 30, 3), value, np.uint8))


def test_numbers_are_those_in_the_names_of_images(tmp_path: Path) -> None:
    for number in (7, 12, 100):
        picture(tmp_path / f"frame{number:04d}.png", number)
    write_sticks(tmp_path / "sticks.txt", {12: [TRUTH], 100: [TRUTH, TRUTH + 5]})
    seen = list(open_true_images(tmp_path, read_stick_truth(tmp_path / "sticks.txt", tmp_path)))
    assert [(int(frame.image[0, 0, 0]), len(people)) for frame, people in seen] == [(12, 1), (100, 2)]
    np.testing.assert_allclose(seen[0][1][0], TRUTH, atol=0.01)
    write_sticks(tmp_path / "sticks.txt", {3: [TRUTH]})
    with pytest.raises(InputError, match="no image number 3"):
        list(open_true_images(tmp_path, read_stick_truth(tmp_path / "sticks.txt", tmp_path)))


def test_keypoints_count_images_and_leave_out_what_they_lack(tmp_path: Path) -> None:
    for name in ("b.png", "a.png"):
        picture(tmp_path / name, ord(name[0]))
    names = [name for name in MODEL.joint_names if name != "left_wrist"]
    joints = [[*MODEL.likely_puppet().joints[MODEL.joint_names.index(name)], 1.0] for name in names]
    path = tmp_path / "keypoints.json"
    path.write_text(json.dumps({"joint_names": names, "frames": {"1": [joints], "0": []}}))
    ((frame, (sticks,)),) = open_true_images(tmp_path, read_stick_truth(path, tmp_path))
    assert int(frame.image[0, 0, 0]) == ord("b")
    assert np.isnan(sticks).any(axis=(1, 2)).tolist() == [stick == "left_lower_arm" for stick in STICKS]


def test_other_detectors_count_images_from_0_or_name_them(tmp_path: Path) -> None:
    for number in (7, 12):
        picture(tmp_path / f"frame{number:04d}.png", number)
    shown = {"left_shoulder": {"x": 100.0, "y": 40.0}, "left_elbow": {"x": 110.0, "y": 80.0}}
    path = tmp_path / "landmarks.json"
    for frames in ([None, shown], [{"image": "frame12.jpg", "landmarks": shown}]):
        path.write_text(json.dumps(frames))
        ((frame, (sticks,)),) = open_true_images(tmp_path, read_stick_truth(path, tmp_path))
        assert int(frame.image[0, 0, 0]) == 12
        np.testing.assert_array_equal(sticks[STICKS.index("left_upper_arm")], [[100, 40], [110, 80]])


def test_annotations_name_images_and_frames_of_clips(tmp_path: Path) -> None:
    picture(tmp_path / "one.png", 50)
    writer = cv2.VideoWriter(str(tmp_path / "clip.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (32, 32))
    for value in range(0, 250, 50):
        writer.write(np.full((32, 32, 3), value, np.uint8))
    writer.release()
    joints = np.column_stack([MODEL.likely_puppet().joints, np.ones(len(MODEL.joint_names))])
    joints[MODEL.joint_names.index("right_elbow"), 2] = 0
    person = {"joints": joints.tolist(), "gender": "neutral", "view": "front"}
    images = {"one.png": [person], "clip.avi#1": [person], "clip.avi#3": [person, person], "clip.avi#4": []}
    path = tmp_path / "annotations.json"
    path.write_text(json.dumps({"joint_names": MODEL.joint_names, "images": images}))
    seen = list(open_true_images(tmp_path, read_stick_truth(path, tmp_path)))
    assert [len(people) for _, people in seen] == [1, 1, 2]
    assert [
        abs(int(frame.image[8, 8, 0]) - value) < 8 for (frame, _), value in zip(seen, (50, 50, 150), strict=True)
    ] == [True] * 3
    unknown = np.isnan(seen[0][1][0]).any(axis=(1, 2))
    assert unknown.tolist() == [name in ("right_upper_arm", "right_lower_arm") for name in STICKS]


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"images": {"a": [{}]}}', '{"images": 3, "joint_names": []}', '{"frames": {}}']
)
def test_broken_truth_is_one_sentence(tmp_path: Path, text: str) -> None:
    path = tmp_path / "truth.json"
    path.write_text(text)
    with pytest.raises(InputError):
        read_stick_truth(path, tmp_path)
    with pytest.raises(InputError):
        read_stick_truth(tmp_path / "missing.json", tmp_path)
