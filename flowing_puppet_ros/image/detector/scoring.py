# SPDX-License-Identifier: Apache-2.0
"""Which of the poses that were found are people, how large they are, and how probable that is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.image.detector.detection import PoseHypothesis
from flowing_puppet_ros.image.detector.part_filters import PARTS

FEATURES = 8  # of a pose: root filter, trees, relative scale, pose, share outside of the image, and three of skin
SAME_PLACE = 0.5  # units of S between necks of which only the better is kept
SAME_HEAD = 0.35  # units of S between necks of poses that tell the scale of one person together
LENGTHS = np.array([[0.6, 0.2, 0.5], [1.4, 0.7, 2.0]])  # units of S: shoulders, head and trunk of somebody; see lengths


@dataclass(frozen=True, slots=True, eq=False)
class PoseScorer:
    """What was learned from poses on images that the filters had not seen.

    `weight` (MEASURES,) of a pose's measures gives its score; `scale` (4,) the logarithm of the correction of S from
    those of three lengths and 1; `odds` (2,) slope and offset of the log-odds that a pose is right, from its score.
    """

    weight: F64
    scale: F64
    odds: F64

    def scores(self, poses: Sequence[PoseHypothesis]) -> F64:
        """Score (N,) of every pose."""
        return np.array([float(self.weight @ pose.features) for pose in poses])

    def log_odds(self, score: float) -> float:
        """Log-odds that a pose of this score is that of a person."""
        return float(self.odds[0] * score + self.odds[1])

    def probability(self, score: float) -> float:
        """Probability that a pose of this score is that of a person."""
        return 1 / (1 + float(np.exp(-self.log_odds(score))))

    def corrected_scale(self, pose: PoseHypothesis, scale: float) -> float:
        """S of a person whose poses agree on about `scale`, by the lengths in the best one."""
        return scale * float(np.exp(np.clip(self.scale @ length_ratios(pose, scale), -0.4, 0.4)))


def suppress_duplicates(poses: Sequence[PoseHypothesis], scores: F64) -> list[int]:
    """Indices of the best poses, each the best around its place, best first."""
    kept: list[int] = []
    for index in np.argsort(-scores, kind="stable").tolist():
        if all(neck_distance(poses[index], poses[other]) >= SAME_PLACE for other in kept):
            kept.append(index)
    return kept


def agree_on_scale(poses: Sequence[PoseHypothesis], scores: F64, best: int) -> float:
    """Mean scale (of logarithms, weighted by exp(score)) of the poses with the same head as pose `best`."""
    near = np.array([neck_distance(pose, poses[best]) < SAME_HEAD for pose in poses])
    weight = np.where(near, np.exp(np.minimum(scores - scores[best], 0.0)), 0.0)
    return float(np.exp(weight @ np.log([pose.scale for pose in poses]) / weight.sum()))


def length_ratios(pose: PoseHypothesis, scale: float) -> F64:
    """Logarithms of the width of the shoulders, of the head's and of the trunk's length in units of S, and 1: (4,).

    The thesis regresses the scale on head and shoulders of a stickman. Lengths beyond LENGTHS count as its ends: where
    both shoulders are taken for the same one, their distance tells of an error and not of a small person.
    """
    place = dict(zip(PARTS, pose.points, strict=True))
    shoulders, hips = ((place[f"right_{name}"], place[f"left_{name}"]) for name in ("shoulder", "hip"))
    spans = shoulders[0] - shoulders[1], place["neck"] - place["face"], (sum(shoulders) - sum(hips)) / 2
    measured = np.array([float(np.linalg.norm(span)) / scale for span in spans])
    return np.append(np.log(np.clip(measured, *LENGTHS)), 1.0)


def neck_distance(a: PoseHypothesis, b: PoseHypothesis) -> float:
    """Distance of two necks in units of the larger S."""
    return float(np.linalg.norm(a.points[0] - b.points[0])) / max(a.scale, b.scale)
