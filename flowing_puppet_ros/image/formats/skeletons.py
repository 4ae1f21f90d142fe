# SPDX-License-Identifier: Apache-2.0
"""Names of the keypoints of the detectors in use, in the order of their numbers from 0.

Left and right are the person's. Spellings are those that `keypoints.normalise_name` reads, so that a name means the
same place whoever found it. Names that it does not know (clavicles, thumbs, small toes) are there to keep the count.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence


def _list_pairs(*names: str) -> tuple[str, ...]:
    """Return left before right of each name."""
    return tuple(f"{side}_{name}" for name in names for side in ("left", "right"))


def _list_sides(first: str, second: str, names: Sequence[str]) -> tuple[str, ...]:
    """Return all names of one side, then all of the other."""
    return tuple(f"{side}_{name}" for side in (first, second) for name in names)


ARM = ("shoulder", "elbow", "wrist")
LEG = ("hip", "knee", "ankle")

COCO_17 = ("nose", *_list_pairs("eye", "ear", *ARM, *LEG))
"""COCO keypoints: MoveNet, YOLO-pose (yolo_msgs counts these from 1), RTMPose, ViTPose, Detectron2, AlphaPose."""

COCO_WHOLEBODY = (*COCO_17, *_list_sides("left", "right", ("big_toe", "small_toe", "heel")))
"""The first 23 of the 133 points of COCO-WholeBody; face and fingers follow."""

HALPE_26 = (*COCO_17, "head_top", "neck", "pelvis", *_list_pairs("big_toe", "small_toe", "heel"))
"""Halpe (AlphaPose, RTMPose body with feet), also the first 26 of its 136 points. Its "head" is the top of the head."""

OPENPOSE_18 = (
    "nose",
    "neck",
    *_list_sides("right", "left", ARM),
    *_list_sides("right", "left", LEG),
    *("right_eye", "left_eye", "right_ear", "left_ear"),
)
"""OpenPose's COCO model and BODY_18 of the ZED SDK: the right eye first."""

HRI_18 = (*OPENPOSE_18[:14], *_list_pairs("eye", "ear"))
"""hri_msgs/Skeleton2D (ROS4HRI, REP-155): as OpenPose's 18, but the left eye first."""

OPENPOSE_25 = (
    "nose",
    "neck",
    *_list_sides("right", "left", ARM),
    "pelvis",
    *_list_sides("right", "left", LEG),
    *("right_eye", "left_eye", "right_ear", "left_ear"),
    *_list_sides("left", "right", ("big_toe", "small_toe", "heel")),
)
"""BODY_25, OpenPose's default."""

MEDIAPIPE_33 = (
    "nose",
    *_list_sides("left", "right", ("eye_inner", "eye", "eye_outer")),
    *_list_pairs("ear", "mouth", *ARM, "pinky", "index", "thumb", *LEG, "heel", "foot_index"),
)
"""BlazePose and MediaPipe's pose landmarks."""

_ZED_34_ARM = ("clavicle", *ARM, "hand", "hand_tip", "thumb")
ZED_34 = (
    *("pelvis", "naval_spine", "chest_spine", "neck"),
    *_list_sides("left", "right", _ZED_34_ARM),
    *_list_sides("left", "right", (*LEG, "foot")),
    *("head", "nose", "left_eye", "left_ear", "right_eye", "right_ear", "left_heel", "right_heel"),
)
"""BODY_34 of the ZED SDK; "head" is the middle of the head."""

ZED_38 = (
    *("pelvis", "spine_1", "spine_2", "spine_3", "neck", "nose"),
    *_list_pairs("eye", "ear", "clavicle", *ARM, *LEG, "big_toe", "small_toe", "heel"),
    *_list_pairs("hand_thumb", "index", "hand_middle", "hand_pinky"),
)
"""BODY_38 of the ZED SDK, its default. Its index point is the finger's knuckle, as MediaPipe's."""

ZED_FORMATS: Mapping[int, tuple[str, ...]] = {0: OPENPOSE_18, 1: ZED_34, 2: ZED_38}
"""Orders by `body_format` of zed_msgs/Object."""
