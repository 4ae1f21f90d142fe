# SPDX-License-Identifier: Apache-2.0
"""Keypoints of any detector, and the puppet joints that correspond to them.

Accepted names: COCO and MediaPipe ("left_shoulder", "nose"), OpenPose BODY_25 and BODY_25B ("LShoulder", "MidHip",
"UpperNeck", "LBigToe"), HRI ("l_shoulder"), and the puppet's own ("belly", "face"), in any case. Left is the person's.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.person_mask import PersonMask

type Point = tuple[float, float, float]  # x, y, confidence

MIDLINE = {
    "nose": ("nose",),
    "face": ("face", "head"),
    "head_top": ("headtop", "tophead"),
    "neck": ("neck", "thorax"),
    "upper_neck": ("upperneck",),
    "belly": ("belly",),
    "pelvis": ("pelvis", "midhip", "hips", "root"),
}
PAIRED = {
    "shoulder": ("shoulder",),
    "elbow": ("elbow",),
    "wrist": ("wrist",),
    "hand": ("hand", "index", "indexfinger"),
    "hip": ("hip",),
    "knee": ("knee",),
    "ankle": ("ankle",),
    "foot": ("foot", "bigtoe", "footindex"),
    "heel": ("heel",),
    "eye": ("eye",),
    "ear": ("ear",),
}
# Puppets that people posed on 31 annotated JHMDB clips, compared with a detector's joints on the same images:
TRUNK_DROP = 0.06  # shoulders and hips lie lower by this share of the trunk's length
SHOULDER_SPREAD = 0.04  # each shoulder lies further out by this share of their distance
EAR_HEIGHT = 0.54  # of the head's centre, as a share of the way from neck to top of the head, in the learned model
MAX_COORDINATE_PX = 1e5  # no camera sees a keypoint beyond


class JointModel(Protocol):
    """The part of a 2D body model that this module needs."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        ...

    def mean_joints(self) -> F64:
        """Return the joints (J, 2) of the average person seen from the front, metres, x right, y down."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """One detected person: `names` (K,), `xy` (K, 2) px with NaN where unknown, `confidence` (K,) in [0, 1].

    `track_id` is the id under which the detector itself tracks the person; empty if it does not. `mask` is where the
    person is in the image, None from a detector that does not say it.
    """

    names: tuple[str, ...]
    xy: F64
    confidence: F64
    track_id: str = ""
    mask: PersonMask | None = None

    def __post_init__(self) -> None:
        """Convert to float64; InputError when the lengths disagree."""
        xy, confidence = np.asarray(self.xy, dtype=np.float64), np.asarray(self.confidence, dtype=np.float64)
        if xy.shape != (len(self.names), 2) or confidence.shape != (len(self.names),):
            raise InputError(
                f"{len(self.names)} keypoint names need as many (x, y) and confidences, "
                f"these have shapes {xy.shape} and {confidence.shape}"
            )
        object.__setattr__(self, "xy", xy)
        object.__setattr__(self, "confidence", confidence)

    def select_usable(self) -> dict[str, Point]:
        """Return {name: (x, y, confidence)} of keypoints with known names, finite places and positive confidence."""
        found: dict[str, Point] = {}
        for name, (x, y), confidence in zip(self.names, self.xy, self.confidence, strict=True):
            known = normalise_name(name)
            if known is None or not (abs(x) < MAX_COORDINATE_PX and abs(y) < MAX_COORDINATE_PX and confidence > 0):
                continue
            # Detectors without a score send large counts or visibilities; anything over 1 is certain.
            candidate = (float(x), float(y), min(1.0, float(confidence)))
            if known not in found or candidate[2] > found[known][2]:
                found[known] = candidate
        return found


def _list_spellings() -> dict[str, str]:
    """Return every accepted spelling, lower case, without separators: {"lshoulder": "left_shoulder", ...}."""
    table = {spelling: name for name, spellings in MIDLINE.items() for spelling in spellings}
    for name, spellings in PAIRED.items():
        for spelling in spellings:
            for side in ("left", "right"):
                for mark in (side, side[0]):
                    table[mark + spelling] = table[spelling + mark] = f"{side}_{name}"
    return table


SPELLINGS = _list_spellings()


def normalise_name(name: str) -> str | None:
    """Return our name for a detector's keypoint ("LShoulder" gives "left_shoulder"); None for an unknown one."""
    return SPELLINGS.get(re.sub("[^a-z0-9]", "", name.lower()))


def joints_from_keypoints(model: JointModel, keypoints: Keypoints) -> tuple[F64, F64]:
    """Return the puppet joints (J, 2) px, NaN where unknown, and their confidence (J,), 0 where unknown.

    By the kind of skeleton:
        with a belly         a puppet's own joints, taken as they are
        a detector's         elbows, wrists, knees and ankles are taken as they are, shoulders and hips are moved to
                             where annotators place them on puppets, and neck, belly and face (the head's centre, midway
                             between the ears) are derived
    """
    usable = keypoints.select_usable()
    if "belly" not in usable:
        _place_face(usable)
        _place_trunk(usable, dict(zip(model.joint_names, model.mean_joints(), strict=True)))
    joints, confidence = np.full((len(model.joint_names), 2), np.nan), np.zeros(len(model.joint_names))
    for index, name in enumerate(model.joint_names):
        if name in usable:
            joints[index] = usable[name][:2]
            confidence[index] = usable[name][2]
    return joints, confidence


def _interpolate(a: Point, b: Point, share: float) -> Point:
    """Return the point `share` of the way from a to b (beyond them outside [0, 1]), with the lower confidence."""
    return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), min(a[2], b[2])


def _place_face(found: dict[str, Point]) -> None:
    """Add the face to `found` unless it is there.

    The first of these that is known serves:
    1. upper neck and top of the head
    2. the middle of the ears or of the eyes, whichever is more confident (in profile one of a pair is a guess, and its
       confidence says so)
    3. the nose or one ear
    """
    if "face" in found:
        return
    if "upper_neck" in found and "head_top" in found:
        found["face"] = _interpolate(found["upper_neck"], found["head_top"], EAR_HEIGHT)
        return
    pairs = [(f"left_{name}", f"right_{name}") for name in ("ear", "eye")]
    middles = [
        _interpolate(found[left], found[right], 0.5) for left, right in pairs if left in found and right in found
    ]
    singles = [found[name] for name in ("nose", "left_ear", "right_ear") if name in found]
    if middles:
        found["face"] = max(middles, key=lambda point: point[2])
    elif singles:
        found["face"] = singles[0]


def _place_trunk(found: dict[str, Point], mean: dict[str, F64]) -> None:
    """Move shoulders and hips, and put neck and belly on the line from mid-hip to mid-shoulder as in the mean puppet.

    A detector's neck is the middle of its shoulders and adds nothing; an upper neck is the puppet's neck.
    """
    found.pop("neck", None)
    sides = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")
    if all(name in found for name in sides):
        left, right, left_hip, right_hip = (found[name] for name in sides)
        shoulders, pelvis = _interpolate(left, right, 0.5), _interpolate(left_hip, right_hip, 0.5)
        down = TRUNK_DROP * (pelvis[0] - shoulders[0]), TRUNK_DROP * (pelvis[1] - shoulders[1])
        found["left_shoulder"] = _interpolate(left, right, -SHOULDER_SPREAD)
        found["right_shoulder"] = _interpolate(right, left, -SHOULDER_SPREAD)
        shoulder_y, hip_y = ((mean["left" + end][1] + mean["right" + end][1]) / 2 for end in ("_shoulder", "_hip"))
        for name in ("neck", "belly"):
            share = (mean[name][1] - hip_y) / (shoulder_y - hip_y)
            found[name] = _interpolate(pelvis, shoulders, float(share))
        for name in (*sides, "neck", "belly"):
            x, y, confidence = found[name]
            found[name] = x + down[0], y + down[1], confidence
    if "upper_neck" in found:
        found["neck"] = found["upper_neck"]
