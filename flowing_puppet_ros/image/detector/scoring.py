# SPDX-License-Identifier: Apache-2.0
"""Scores of poses: which of them are people, at what scale, and how probable that is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.image.detector.detection import PoseHypothesis
from flowing_puppet_ros.image.detector.part_filters import PARTS

FEATURES = 8  # of a pose: root filter, trees, relative scale, pose, share outside the image, and three of skin
MIN_NECK_DISTANCE = 0.5  # units of S; of poses whose necks are nearer only the best is kept
SAME_HEAD_DISTANCE = 0.35  # units of S; poses whose necks are nearer share the estimate of a person's scale
LENGTH_LIMITS = np.array([[0.6, 0.2, 0.5], [1.4, 0.7, 2.0]])
"""Minimum and maximum of shoulder width, head length and trunk length, units of S."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseScorer:
    """Regressions learned from poses on images that the filters had not seen.

    Attributes:
        weight: (FEATURES,) of a pose's features in its score.
        scale: (4,) weights of the logarithms of three lengths, and of 1, in the logarithm of the correction of S.
        odds: (2,) slope and offset of the log-odds that a pose is right, from its score.
    """

    weight: F64
    scale: F64
    odds: F64

    def score(self, poses: Sequence[PoseHypothesis]) -> F64:
        """Return the score (N,) of every pose."""
        return np.array([float(self.weight @ pose.features) for pose in poses])

    def log_odds(self, score: float) -> float:
        """Return the log-odds that a pose of this score is that of a person."""
        return float(self.odds[0] * score + self.odds[1])

    def probability(self, score: float) -> float:
        """Return the probability that a pose of this score is that of a person."""
        return 1 / (1 + float(np.exp(-self.log_odds(score))))

    def correct_scale(self, pose: PoseHypothesis, scale: float) -> float:
        """Correct `scale`, on which a person's poses agree, by the lengths in the best one, and return S."""
        return scale * float(np.exp(np.clip(self.scale @ log_length_ratios(pose, scale), -0.4, 0.4)))


def suppress_duplicates(poses: Sequence[PoseHypothesis], scores: F64) -> list[int]:
    """Return the indices of the poses that score best around their necks, best first."""
    kept: list[int] = []
    for index in np.argsort(-scores, kind="stable").tolist():
        if all(neck_distance(poses[index], poses[other]) >= MIN_NECK_DISTANCE for other in kept):
            kept.append(index)
    return kept


def agree_on_scale(poses: Sequence[PoseHypothesis], scores: F64, best: int) -> float:
    """Return the geometric mean scale, weighted by exp(score), of the poses with the same head as pose `best`."""
    same_head = np.array([neck_distance(pose, poses[best]) < SAME_HEAD_DISTANCE for pose in poses])
    weight = np.where(same_head, np.exp(np.minimum(scores - scores[best], 0.0)), 0.0)
    return float(np.exp(weight @ np.log([pose.scale for pose in poses]) / weight.sum()))


def log_length_ratios(pose: PoseHypothesis, scale: float) -> F64:
    """Return the logarithms of shoulder width, head length and trunk length in units of S, and 1: (4,).

    The thesis regresses the scale on head and shoulders of a stickman. Lengths are clipped to LENGTH_LIMITS: where both
    shoulders were placed on the same one, a short distance is an error and not a small person.
    """
    points = dict(zip(PARTS, pose.points, strict=True))
    shoulders, hips = ((points[f"right_{name}"], points[f"left_{name}"]) for name in ("shoulder", "hip"))
    spans = shoulders[0] - shoulders[1], points["neck"] - points["face"], (sum(shoulders) - sum(hips)) / 2
    lengths = np.array([float(np.linalg.norm(span)) / scale for span in spans])
    return np.append(np.log(np.clip(lengths, *LENGTH_LIMITS)), 1.0)


def neck_distance(a: PoseHypothesis, b: PoseHypothesis) -> float:
    """Return the distance of two necks in units of the larger S."""
    return float(np.linalg.norm(a.points[0] - b.points[0])) / max(a.scale, b.scale)
