# SPDX-License-Identifier: Apache-2.0
"""Measure a person by definitions near those of ISO 7250-1 and ISO 8559-1, in the template's pose.

The pose is the model's: upright, legs and straight arms apart. Levels are found on the surface itself, so that the same
definitions hold for any closed mesh of a person in that pose.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.body.measurements.sections import Sections, signed_volume
from flowing_puppet_ros.body.measurements.standard_pose import to_standard_pose
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

LEVEL_STEP_M = 0.005
CROTCH_SHARES, ARMPIT_SHARES = (0.36, 0.56), (0.66, 0.80)
"""Shares of the stature between which legs and arms part from the trunk."""
CHEST_SHARES = (0.06, 0.01)
"""Distances of the levels of the chest below the armpits, in statures."""
HIP_SHARE = 0.10
"""Distance of the hips' highest level above the crotch, in statures."""


@dataclass(frozen=True, slots=True)
class Definition:
    """What a measurement is, its unit, and the power in which it grows with the size of a person."""

    unit: str
    text: str

    @property
    def dimension(self) -> int:
        """1 of lengths, 3 of volumes."""
        return 3 if self.unit == "m3" else 1


DEFINITIONS = {
    "stature": Definition("m", "height of the top of the head above the soles"),
    "chest_girth": Definition(
        "m", "largest horizontal girth of the trunk from 1 to 6 % of the stature below the armpits"
    ),
    "waist_girth": Definition("m", "smallest horizontal girth of the trunk between the levels of hips and chest"),
    "hip_girth": Definition("m", "largest horizontal girth from the crotch to 10 % of the stature above it"),
    "inseam": Definition("m", "height of the crotch above the soles, inside leg height"),
    "arm_length": Definition("m", "from the shoulder's joint over the elbow's to the wrist's, mean of both arms"),
    "shoulder_width": Definition("m", "between the joints of the shoulders"),
    "volume": Definition("m3", "inside the closed surface"),
}
"""All measurements, in the order in which they are told."""


def measure_fit(model: StitchedPuppet, state: BodyState, vertices: Array | None = None) -> dict[str, float]:
    """Return the measurements of a fit in any pose; `vertices` (V, 3) as in `to_standard_pose`."""
    standard = to_standard_pose(model, state, vertices)
    joints = dict(zip(model.joint_names, model.joints(standard), strict=True))
    return measure(standard, model.faces, joints)


def measure(vertices: Array, faces: Array, joints: Mapping[str, Array]) -> dict[str, float]:
    """Return the measurements (`DEFINITIONS`) of a person in the template's pose, in metres.

    Args:
        vertices: (V, 3) metres, z up.
        faces: (F, 3) of the closed mesh, counter-clockwise from outside.
        joints: name -> (3,) of both shoulders, elbows and wrists.
    """
    sections = Sections(vertices, faces)
    soles = float(sections.vertices[:, 2].min())
    stature = float(sections.vertices[:, 2].max()) - soles
    crotch = sections.find_level(
        soles + CROTCH_SHARES[0] * stature, soles + CROTCH_SHARES[1] * stature, lambda loops: _count_legs(loops) == 2
    )
    armpit = sections.find_level(
        soles + ARMPIT_SHARES[0] * stature, soles + ARMPIT_SHARES[1] * stature, lambda loops: len(loops) == 3
    )
    hips = _scan(sections, crotch + LEVEL_STEP_M, crotch + HIP_SHARE * stature)
    chest = _scan(sections, armpit - CHEST_SHARES[0] * stature, armpit - CHEST_SHARES[1] * stature)
    between = _scan(sections, crotch + HIP_SHARE * stature, armpit - CHEST_SHARES[0] * stature)
    return {
        "stature": stature,
        "chest_girth": max(chest),
        "waist_girth": min(between),
        "hip_girth": max(hips),
        "inseam": crotch - soles,
        "arm_length": sum(_measure_arm(joints, side) for side in ("left", "right")) / 2,
        "shoulder_width": float(np.linalg.norm(joints["left_shoulder"] - joints["right_shoulder"])),
        "volume": signed_volume(sections.vertices, faces),
    }


def _scan(sections: Sections, low: float, high: float) -> list[float]:
    """Return the girths of the trunk at levels from low to high."""
    return [sections.trunk_girth(level) for level in np.arange(low, high, LEVEL_STEP_M)]


def _count_legs(loops: list[Array]) -> int:
    """Return the number of loops of legs or trunk: those that are wide from side to side, unlike hands beside them."""
    largest = max((np.ptp(loop[:, 1]) for loop in loops), default=0.0)
    return sum(np.ptp(loop[:, 1]) > largest / 2 for loop in loops)


def _measure_arm(joints: Mapping[str, Array], side: str) -> float:
    upper = np.linalg.norm(joints[f"{side}_elbow"] - joints[f"{side}_shoulder"])
    return float(upper + np.linalg.norm(joints[f"{side}_wrist"] - joints[f"{side}_elbow"]))
