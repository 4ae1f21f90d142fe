# SPDX-License-Identifier: Apache-2.0
"""Crops a cloud to the surroundings of limbs at known joints: visual hulls have fins where no camera looks."""

from __future__ import annotations

from collections.abc import Container, Mapping

import numpy as np

# Tapered capsules between joints: two joints and the radius at each in metres; the limbs stand once for both sides.
LIMB_CAPSULES: tuple[tuple[str, str, float, float], ...] = (
    ("shoulder", "elbow", 0.055, 0.045),
    ("elbow", "wrist", 0.045, 0.035),
    ("wrist", "hand", 0.045, 0.045),
    ("hip", "knee", 0.095, 0.06),
    ("knee", "ankle", 0.065, 0.045),
    ("ankle", "toe", 0.05, 0.045),
)
TRUNK_CAPSULES: tuple[tuple[str, str, float, float], ...] = (
    ("left_shoulder", "right_shoulder", 0.08, 0.08),
    ("neck", "pelvis", 0.13, 0.14),
    ("left_hip", "right_hip", 0.11, 0.11),
    ("left_shoulder", "left_hip", 0.09, 0.11),
    ("right_shoulder", "right_hip", 0.09, 0.11),
    ("neck", "head_top", 0.08, 0.11),
)


def crop_to_limbs(points: np.ndarray, joints: Mapping[str, np.ndarray], factor: float) -> np.ndarray:
    """Return which points (N,) lie within `factor` limb radii of the limbs' axes.

    Args:
        points: (N, 3) metres.
        joints: positions (3,) of a body's joints in metres; capsules with an unknown joint are left out.
        factor: multiple of the radii, about 1.5 to 2.5 for hulls.
    """
    near = np.zeros(len(points), dtype=bool)
    for capsule in list_capsules(joints):
        near |= _inside_capsule(points, capsule[:3], capsule[3:6], factor * capsule[6], factor * capsule[7])
    return near


def list_capsules(joints: Mapping[str, np.ndarray], ends: Container[str] | None = None) -> np.ndarray:
    """Return the capsules (C, 8) of a body: two ends and the radius at each, metres.

    `joints` are positions (3,) m by name; capsules with an unknown joint are left out, and those whose second joint,
    the farther one from the trunk, is not among `ends`, if given.
    """
    sides = [(f"{side}_{a}", f"{side}_{b}", ra, rb) for side in ("left", "right") for a, b, ra, rb in LIMB_CAPSULES]
    rows = [
        [*joints[first], *joints[second], first_radius, second_radius]
        for first, second, first_radius, second_radius in (*sides, *TRUNK_CAPSULES)
        if first in joints and second in joints and (ends is None or second in ends)
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, 8)


def _inside_capsule(points: np.ndarray, a: np.ndarray, b: np.ndarray, radius_a: float, radius_b: float) -> np.ndarray:
    axis = b - a
    along = np.clip((points - a) @ axis / max(float(axis @ axis), 1e-9), 0.0, 1.0)
    distance = np.linalg.norm(points - a - along[:, None] * axis, axis=1)
    return distance < radius_a + along * (radius_b - radius_a)
