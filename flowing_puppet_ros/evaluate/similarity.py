# SPDX-License-Identifier: Apache-2.0
"""How alike found and true people are: COCO's object keypoint similarity (OKS), and median errors by a person's size.

People are joints {our name: (2,) px}, of which unknown ones are absent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from flowing_puppet_ros.arrays import Array, Bools

type Joints2D = Mapping[str, Array]
"""One person: joints (2,) px by name."""

_SIGMAS = {
    "eye": 0.025,
    "ear": 0.035,
    "shoulder": 0.079,
    "elbow": 0.072,
    "wrist": 0.062,
    "hip": 0.107,
    "knee": 0.087,
    "ankle": 0.089,
}
SIGMAS: Mapping[str, float] = {"nose": 0.026} | {
    f"{side}_{kind}": sigma for kind, sigma in _SIGMAS.items() for side in ("left", "right")
}
"""COCO's standard deviations of annotators, by joint, as shares of the square root of the person's area."""

FILLED_SHARE = 0.53
"""Area of a person as a share of their box, where no outline is annotated (as the evaluation of CrowdPose takes it)."""
GROWN_SHARE = 0.05
"""A person's box exceeds that of their joints on each side by this share of its longer side."""
SAME_SHARE = 0.2
"""Who is found with a median error up to this share of a true person's extent stands on that person, well or badly."""


def measure_extent(joints: Joints2D) -> float:
    """Return the longer side of the box around all joints, px; 0 for a single joint or none."""
    return float(np.ptp(np.array([*joints.values()]), axis=0).max()) if joints else 0.0


def estimate_area(joints: Joints2D) -> float:
    """Return a person's area in square pixels from the box around all joints; 0 for a single joint or none."""
    if not joints:
        return 0.0
    sides = np.ptp(np.array([*joints.values()]), axis=0)
    return FILLED_SHARE * float(np.prod(sides + 2 * GROWN_SHARE * sides.max()))


def can_compare(person: Joints2D, names: Sequence[str]) -> bool:
    """Return whether a true person has an extent, and one of the joints `names`."""
    return measure_extent(person) > 0 and any(name in person for name in names)


def measure_similarity(found: Sequence[Joints2D], true: Sequence[Joints2D], names: Sequence[str]) -> Array:
    """Return the OKS (F, T) of each found with each true person over the true joints among `names`.

    A joint that the found person lacks has similarity 0. A true person who cannot be compared has a column of NaN.
    `names` must be in SIGMAS (cocodataset.org, "Keypoint Evaluation").
    """
    similarity = np.full((len(found), len(true)), np.nan)
    for column, person in enumerate(true):
        if not can_compare(person, names):
            continue
        known = [name for name in names if name in person]
        variance = estimate_area(person) * (2 * np.array([SIGMAS[name] for name in known])) ** 2
        for row, other in enumerate(found):
            apart = _distances(other, person, known)
            similarity[row, column] = np.exp(-(apart**2) / (2 * variance)).mean()
    return similarity


def measure_shares(found: Sequence[Joints2D], true: Sequence[Joints2D], names: Sequence[str]) -> Array:
    """Return median errors (F, T) over the true joints among `names`, as shares of the true person's extent.

    A joint that the found person lacks is infinitely far. A true person who cannot be compared has a column of NaN.
    """
    shares = np.full((len(found), len(true)), np.nan)
    for column, person in enumerate(true):
        if can_compare(person, names):
            known = [name for name in names if name in person]
            shares[:, column] = [
                np.median(_distances(other, person, known)) / measure_extent(person) for other in found
            ]
    return shares


def stand_on_anybody(found: Sequence[Joints2D], true: Sequence[Joints2D], names: Sequence[str]) -> Bools:
    """Return whether each found person (F,) stands on some true person, see SAME_SHARE."""
    return np.asarray((measure_shares(found, true, names) <= SAME_SHARE).any(axis=1))


def _distances(found: Joints2D, true: Joints2D, names: Sequence[str]) -> Array:
    """Return the distances (n,) px of joints; infinite where they were not found."""
    return np.array([np.linalg.norm(found[name] - true[name]) if name in found else np.inf for name in names])
