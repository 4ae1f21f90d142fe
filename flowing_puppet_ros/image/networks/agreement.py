# SPDX-License-Identifier: Apache-2.0
"""One pose of several networks' poses of one person, and how probably each joint is right.

A network's own score says little about where a joint is: two networks that put it in the same place are hardly ever
both wrong.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.image.formats.skeletons import COCO_17
from flowing_puppet_ros.image.networks.poses import OTHER_SIDE, NetworkPose

DISTANCES = (0.0, 0.1, 0.2, 0.4, 0.7, 1.0)  # between networks, in shoulder widths ...
PROBABILITIES = (1.0, 0.9, 0.7, 0.35, 0.12, 0.05)  # ... and how probably the mean is right
SURE_SCORE = 0.65  # mean score from which the agreement alone counts
CALIBRATION = (
    (0.0, 0.05, 0.15, 0.35, 0.5, 0.65, 0.75, 0.85, 1.0),
    (0.0, 0.15, 0.58, 0.78, 0.83, 0.91, 0.95, 0.98, 0.99),
)
"""Confidence of an elbow or wrist, and the probability that it is within a quarter of the shoulder width: measured on
118 clips of JHMDB, against the joints of MediaPipe's tracker there."""
MAX_CROSSED = 0.7  # of the distance of two poses: if that with left and right exchanged is below, one is the wrong way

MIN_WEIGHT = 1e-3


def combine(networks: Sequence[Sequence[NetworkPose]], trusts: Sequence[F64], size: float) -> tuple[F64, F64]:
    """Return the mean joints (17, 2) px of a person's poses, and their confidence (17,).

    Args:
        networks: the poses by each network, of which there is at least one.
        trusts: for each network a factor (17,) on the scores of its joints.
        size: the person's shoulder width, px.

    Poses are weighted by their scores. Two poses by one network agree even when they are wrong: the confidence is how
    well the means of the networks agree, or the scores alone where there is one network.
    """
    joints = [np.array([pose.joints for pose in poses]) for poses in networks]
    scores = [np.maximum([pose.scores for pose in poses], MIN_WEIGHT) for poses in networks]
    means = [_weighted_mean(*pair) for pair in zip(joints, scores, strict=True)]
    weight = np.array([own.sum(axis=0) * trust for own, trust in zip(scores, trusts, strict=True)])
    mean = _weighted_mean(np.array(means), weight)
    sure = np.minimum(np.concatenate(scores).mean(axis=0) / SURE_SCORE, 1.0)
    if len(networks) == 1:
        return mean, sure
    apart = np.max([np.hypot(*(one - other).T) for one in means for other in means], axis=0) / size
    return mean, np.interp(apart, DISTANCES, PROBABILITIES) * sure


def _weighted_mean(joints: F64, weight: F64) -> F64:
    """Return the mean (17, 2) of joints (N, 17, 2) by their weights (N, 17)."""
    return np.asarray((weight[..., None] * joints).sum(axis=0) / weight.sum(axis=0)[:, None])


def calibrate(confidence: F64) -> F64:
    """Return how probably joints are right by their confidence, which `combine` gives and a tracker has fused."""
    return np.asarray(np.interp(confidence, *CALIBRATION), np.float64)


def turn_sides(poses: Sequence[NetworkPose], known: F64 | None) -> list[NetworkPose]:
    """Return poses of one person with left and right as in most places.

    Where two poses fit far better with the sides of one exchanged, the `known` joints (17, 2) px of the person, NaN
    where unknown, decide which is right; without them the last of the poses.
    """
    if len(poses) < 2:
        return list(poses)
    judge = poses[-1].joints if known is None or not np.isfinite(known).any() else known
    if not any(_is_crossed(pose.joints, poses[-1].joints) for pose in poses[:-1]):
        return list(poses)
    return [pose.exchange_sides() if _is_crossed(pose.joints, judge) else pose for pose in poses]


def _is_crossed(one: F64, other: F64) -> bool:
    """Return whether two poses (17, 2) px fit far better with the sides of one exchanged."""
    paired = np.arange(len(COCO_17)) != OTHER_SIDE
    straight, crossed = one - other, one[OTHER_SIDE] - other
    known = paired & np.isfinite(straight).all(axis=1) & np.isfinite(crossed).all(axis=1)
    if not known.any():
        return False
    return float(np.hypot(*crossed[known].T).sum()) < MAX_CROSSED * float(np.hypot(*straight[known].T).sum())
