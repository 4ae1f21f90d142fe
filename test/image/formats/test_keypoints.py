# SPDX-License-Identifier: Apache-2.0
"""Names of keypoints from several detectors, and the puppet joints they become."""

import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoints import Keypoints, joints_from_keypoints, normalise_name
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

MODEL = DeformableStructures.load()
SIDED = ("eye", "ear", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")
COCO = ["nose", *(f"{side}_{name}" for name in SIDED for side in ("left", "right"))]
LEFT = [[206, 84], [214, 86], [236, 140], [250, 200], [256, 256], [222, 270], [224, 350], [226, 430]]
FRONTAL = np.array([[200, 90], *([x, y] for left, y in LEFT for x in (left, 400 - left))], float)


def person(names: list[str] | None = None, xy: np.ndarray | None = None) -> Keypoints:
    names = COCO if names is None else names
    return Keypoints(tuple(names), FRONTAL.copy() if xy is None else xy, np.full(len(names), 0.9))


def joint(joints: np.ndarray, name: str) -> np.ndarray:
    found: np.ndarray = joints[MODEL.joint_names.index(name)]
    return found


@pytest.mark.parametrize(
    ("theirs", "ours"),
    [
        ("left_shoulder", "left_shoulder"),
        ("LShoulder", "left_shoulder"),
        ("REar", "right_ear"),
        ("LEar", "left_ear"),
        ("RBigToe", "right_foot"),
        ("LHeel", "left_heel"),
        ("MidHip", "pelvis"),
        ("UpperNeck", "upper_neck"),
        ("HeadTop", "head_top"),
        ("Nose", "nose"),
        ("RIGHT_WRIST", "right_wrist"),
        ("r_elbow", "right_elbow"),
        ("shoulder_left", "left_shoulder"),
        ("Neck", "neck"),
        ("belly", "belly"),
        ("left_index", "left_hand"),
    ],
)
def test_names_of_detectors(theirs: str, ours: str) -> None:
    assert normalise_name(theirs) == ours


@pytest.mark.parametrize("name", ["", "wrist", "left", "tail", "left_nose", "LSmallToe", "3"])
def test_other_names_are_unknown(name: str) -> None:
    assert normalise_name(name) is None


def test_limb_joints_are_the_detectors_and_sides_stay() -> None:
    joints, confidence = joints_from_keypoints(MODEL, person())
    for name in ("left_wrist", "right_wrist", "left_elbow", "right_knee", "left_ankle"):
        np.testing.assert_array_equal(joint(joints, name), FRONTAL[COCO.index(name)])
    assert joint(joints, "left_shoulder")[0] > joint(joints, "right_shoulder")[0]
    np.testing.assert_allclose(confidence, 0.9)


def test_trunk_joints_are_lowered_and_the_others_derived() -> None:
    joints, _ = joints_from_keypoints(MODEL, person())
    assert 140 < joint(joints, "left_shoulder")[1] < 155
    assert 236 < joint(joints, "left_shoulder")[0] < 245
    assert 270 < joint(joints, "right_hip")[1] < 285
    x, y = joint(joints, "neck")
    assert x == pytest.approx(200)
    assert 100 < y < joint(joints, "left_shoulder")[1]
    assert joint(joints, "left_shoulder")[1] < joint(joints, "belly")[1] < joint(joints, "left_hip")[1]
    assert joint(joints, "face").tolist() == [200, 86]


def test_the_mapping_turns_with_the_person() -> None:
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    upright, _ = joints_from_keypoints(MODEL, person())
    lying, _ = joints_from_keypoints(MODEL, person(xy=FRONTAL @ turn.T))
    np.testing.assert_allclose(lying, upright @ turn.T, atol=1e-9)


def test_upper_neck_is_the_puppets_neck_and_a_mid_shoulder_neck_is_not() -> None:
    upper, _ = joints_from_keypoints(MODEL, person([*COCO, "UpperNeck"], np.vstack([FRONTAL, [[203, 121]]])))
    plain, _ = joints_from_keypoints(MODEL, person())
    middle, _ = joints_from_keypoints(MODEL, person([*COCO, "Neck"], np.vstack([FRONTAL, [[200, 140]]])))
    assert joint(upper, "neck").tolist() == [203, 121]
    np.testing.assert_array_equal(middle, plain)


def test_top_of_the_head_and_upper_neck_tell_its_centre() -> None:
    xy = np.vstack([FRONTAL, [[200, 120], [220, 20]]])
    joints, _ = joints_from_keypoints(MODEL, person([*COCO, "UpperNeck", "HeadTop"], xy))
    np.testing.assert_allclose(joint(joints, "face"), [210.8, 66])


def test_a_puppets_own_joints_are_kept() -> None:
    own = np.random.default_rng(0).uniform(0, 300, (len(MODEL.joint_names), 2))
    joints, _ = joints_from_keypoints(MODEL, person(list(MODEL.joint_names), own))
    np.testing.assert_array_equal(joints, own)


def test_bad_keypoints_are_unknown_joints() -> None:
    xy = FRONTAL.copy()
    xy[COCO.index("left_wrist")] = np.nan
    xy[COCO.index("right_wrist"), 0] = np.inf
    xy[COCO.index("left_knee")] = 1e30
    confidence = np.full(17, 0.9)
    confidence[COCO.index("right_knee")] = 0
    confidence[COCO.index("left_ankle")] = np.nan
    confidence[COCO.index("right_ankle")] = 7.0
    joints, sure = joints_from_keypoints(MODEL, Keypoints(tuple(COCO), xy, confidence))
    for name in ("left_wrist", "right_wrist", "left_knee", "right_knee", "left_ankle"):
        assert np.isnan(joint(joints, name)).all()
        assert sure[MODEL.joint_names.index(name)] == 0
    assert sure.max() == 1.0


@pytest.mark.parametrize("names", [[], ["tail", "wing"]])
def test_no_known_keypoint_gives_no_joint(names: list[str]) -> None:
    joints, confidence = joints_from_keypoints(MODEL, person(names, np.zeros((len(names), 2))))
    assert np.isnan(joints).all()
    assert not confidence.any()


def test_in_profile_the_surer_pair_or_the_nose_tells_the_head() -> None:
    confidence = np.full(17, 0.9)
    confidence[COCO.index("left_ear")] = 0.1
    joints, _ = joints_from_keypoints(MODEL, Keypoints(tuple(COCO), FRONTAL, confidence))
    assert joint(joints, "face").tolist() == [200, 84]
    confidence[:5] = [0.9, 0, 0, 0, 0]
    joints, _ = joints_from_keypoints(MODEL, Keypoints(tuple(COCO), FRONTAL, confidence))
    assert joint(joints, "face").tolist() == [200, 90]


def test_lengths_that_disagree_are_refused() -> None:
    with pytest.raises(InputError, match="2 keypoint names need as many"):
        Keypoints(("nose", "neck"), np.zeros((1, 2)), np.ones(1))
