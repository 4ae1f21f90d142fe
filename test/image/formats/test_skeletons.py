# SPDX-License-Identifier: Apache-2.0
"""The orders of other detectors' keypoints, against the numbers in their documentation, written out here one by one."""

import pytest

from flowing_puppet_ros.image.formats import skeletons
from flowing_puppet_ros.image.formats.keypoints import normalise_name

# Numbers as published: the COCO paper's list, OpenPose's output.md, Halpe's readme, MediaPipe's pose chart,
# hri_msgs/Skeleton2D.msg, the ZED SDK's enums BODY_34_PARTS and BODY_38_PARTS.
NUMBERS = {
    "COCO_17": (17, "0 nose 1 left_eye 4 right_ear 5 left_shoulder 8 right_elbow 9 left_wrist"),
    "COCO_WHOLEBODY": (23, "16 right_ankle 17 left_big_toe 19 left_heel 20 right_big_toe"),
    "HALPE_26": (26, "10 right_wrist 17 head_top 18 neck 19 pelvis 20 left_big_toe 25 right_heel"),
    "OPENPOSE_18": (18, "1 neck 2 right_shoulder 7 left_wrist 8 right_hip 13 left_ankle 14 right_eye 17 left_ear"),
    "HRI_18": (18, "2 right_shoulder 11 left_hip 14 left_eye 15 right_eye 16 left_ear 17 right_ear"),
    "OPENPOSE_25": (
        25,
        "4 right_wrist 8 pelvis 9 right_hip 12 left_hip 15 right_eye 18 left_ear 19 left_big_toe 21 "
        "left_heel 24 right_heel",
    ),
    "MEDIAPIPE_33": (
        33,
        "2 left_eye 5 right_eye 7 left_ear 11 left_shoulder 16 right_wrist 19 left_index 24 right_hip 30 "
        "right_heel 31 left_foot_index",
    ),
    "ZED_34": (
        34,
        "3 neck 5 left_shoulder 7 left_wrist 8 left_hand 12 right_shoulder 14 right_wrist 18 left_hip 21 "
        "left_foot 22 right_hip 26 head 27 nose 29 left_ear 33 right_heel",
    ),
    "ZED_38": (
        38,
        "4 neck 5 nose 7 right_eye 10 left_clavicle 12 left_shoulder 17 right_wrist 18 left_hip 23 "
        "right_ankle 24 left_big_toe 29 right_heel 33 right_index",
    ),
}


@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_are_those_of_the_detector(name: str) -> None:
    count, text = NUMBERS[name]
    words = text.split()
    order = getattr(skeletons, name)
    assert len(order) == len(set(order)) == count
    assert [order[int(number)] for number in words[::2]] == words[1::2]


@pytest.mark.parametrize("name", NUMBERS)
def test_arms_and_legs_are_joints_of_the_puppet(name: str) -> None:
    found = [normalise_name(point) for point in getattr(skeletons, name)]
    known = [joint for joint in found if joint is not None]
    assert len(known) == len(set(known)), "two points for one joint would compete"
    limbs = {f"{side}_{part}" for side in ("left", "right") for part in (*skeletons.ARM, *skeletons.LEG, "eye", "ear")}
    assert limbs | {"nose"} <= set(known)
