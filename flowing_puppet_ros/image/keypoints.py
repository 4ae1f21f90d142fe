# SPDX-License-Identifier: Apache-2.0
"""Keypoints of any detector, and the puppet joints that they stand for.

Accepted names: COCO and MediaPipe ("left_shoulder", "nose"), OpenPose BODY_25 and BODY_25B ("LShoulder", "MidHip",
"UpperNeck", "LBigToe"), HRI ("l_shoulder"), and the puppet's own ("belly", "face"), in any case. Left is the person's.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from flowing_puppet_ros.errors import InputError

type Floats = NDArray[np.float64]

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
FARTHEST = 1e5  # px; no camera sees a keypoint beyond


class JointModel(Protocol):
    """What this module needs of a 2D body model."""

    joint_names: tuple[str, ...]

    def mean_joints(self) -> Floats:
        """Joints (J, 2) of the average person seen from the front, metres, x right, y down."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """One detected person: `names` (K), `xy` (K, 2) px with NaN where unknown, `confidence` (K,) in [0, 1]."""

    names: tuple[str, ...]
    xy: Floats
    confidence: Floats

    def __post_init__(self) -> None:
        """Convert to float64; refuse arrays whose lengths disagree."""
        xy, confidence = np.asarray(self.xy, dtype=np.float64), np.asarray(self.confidence, dtype=np.float64)
        if xy.shape != (len(self.names), 2) or confidence.shape != (len(self.names),):
            raise InputError(
                f"{len(self.names)} keypoint names need as many (x, y) and confidences, "
                f"these have shapes {xy.shape} and {confidence.shape}"
            )
        object.__setattr__(self, "xy", xy)
        object.__setattr__(self, "confidence", confidence)

    def usable(self) -> dict[str, tuple[float, float, float]]:
        """The keypoints of known name with finite coordinates and positive confidence: {name: (x, y, confidence)}."""
        found: dict[str, tuple[float, float, float]] = {}
        for name, (x, y), confidence in zip(self.names, self.xy, self.confidence, strict=True):
            known = normalise_name(name)
            if known is None or not (abs(x) < FARTHEST and abs(y) < FARTHEST and confidence > 0):
                continue
            # Detectors without a score send large counts or visibilities: anything over 1 is certain.
            candidate = (float(x), float(y), min(1.0, float(confidence)))
            if known not in found or candidate[2] > found[known][2]:
                found[known] = candidate
        return found


def _spellings() -> dict[str, str]:
    """Every spelling we read, lower case and without separators: {"lshoulder": "left_shoulder", ...}."""
    table = {spelling: name for name, spellings in MIDLINE.items() for spelling in spellings}
    for name, spellings in PAIRED.items():
        for spelling in spellings:
            for side in ("left", "right"):
                for mark in (side, side[0]):
                    table[mark + spelling] = table[spelling + mark] = f"{side}_{name}"
    return table


SPELLINGS = _spellings()


def normalise_name(name: str) -> str | None:
    """Our name of a detector's keypoint ("LShoulder" gives "left_shoulder"); None when it is not one we know."""
    return SPELLINGS.get(re.sub("[^a-z0-9]", "", name.lower()))


def joints_from_keypoints(model: JointModel, keypoints: Keypoints) -> tuple[Floats, Floats]:
    """Puppet joints (J, 2) px, NaN where nothing tells them, and their confidence (J,), 0 where unknown.

    Limb joints are taken as they are. Detectors have no belly, seldom the base of the neck, and mark eyes and ears
    instead of the head's centre: these three are placed on the trunk as the average puppet has them.
    """
    found = keypoints.usable()
    mean = dict(zip(model.joint_names, model.mean_joints(), strict=True))
    _add_middle(found, "shoulders", "left_shoulder", "right_shoulder")
    _add_middle(found, "pelvis", "left_hip", "right_hip")
    _place_face(found)
    _place_trunk(found, mean)
    joints, confidence = np.full((len(mean), 2), np.nan), np.zeros(len(mean))
    for index, name in enumerate(model.joint_names):
        if name in found:
            joints[index] = found[name][:2]
            confidence[index] = found[name][2]
    return joints, confidence


def _add_middle(found: dict[str, tuple[float, float, float]], middle: str, left: str, right: str) -> None:
    if middle not in found and left in found and right in found:
        found[middle] = _mix(found[left], found[right], 0.5)


def _mix(
    a: tuple[float, float, float], b: tuple[float, float, float], share: float
) -> tuple[float, float, float]:
    """The point `share` of the way from a to b (beyond them outside [0, 1]), with the lower confidence."""
    return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), min(a[2], b[2])


def _place_face(found: dict[str, tuple[float, float, float]]) -> None:
    """The head's centre lies between the ears; the nose, then the eyes, are the next best."""
    if "face" in found:
        return
    _add_middle(found, "face", "left_ear", "right_ear")
    if "face" not in found and "nose" in found:
        found["face"] = found["nose"]
    _add_middle(found, "face", "left_eye", "right_eye")


def _place_trunk(found: dict[str, tuple[float, float, float]], mean: dict[str, Floats]) -> None:
    """Neck and belly on the line from mid-hip to mid-shoulder, at the average puppet's heights.

    A detector's neck is the middle of the shoulders or the nape; only with a belly are the joints a puppet's own.
    """
    if "belly" in found or "shoulders" not in found or "pelvis" not in found:
        return
    shoulder_y = (mean["left_shoulder"][1] + mean["right_shoulder"][1]) / 2
    hip_y = (mean["left_hip"][1] + mean["right_hip"][1]) / 2
    for name in ("neck", "belly"):
        share = (mean[name][1] - hip_y) / (shoulder_y - hip_y)
        found[name] = _mix(found["pelvis"], found["shoulders"], float(share))
