# SPDX-License-Identifier: Apache-2.0
"""Choice among hypotheses of an arm in each image of a clip: the path that agrees best with the flow.

A detector is often right in its second or third hypothesis. Over time, the right hypotheses move with the optical flow,
and the others jump. The path of minimum cost is found exactly (Viterbi, "Error bounds for convolutional codes", 1967).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.settings import Settings, setting

JOINT_WEIGHTS = np.array([0.4, 1.0])  # of elbow and wrist in a step's cost: the wrist moves more and is less certain


@dataclass(frozen=True)
class ArmPathSettings(Settings):
    """How the hypotheses of an arm are linked over time."""

    modes: int = setting(8, "hypotheses of each arm taken from the detector", low=1, high=100)
    detector_weight: float = setting(8.0, "weight of the detector's score of elbow and wrist", low=0.0, high=100.0)
    evidence_weight: float = setting(0.5, "weight of contour and colour", low=0.0, high=100.0)
    flow_strength: float = setting(
        60.0, "cost of a step that deviates from the flow by a shoulder width", low=0.0, high=1e4
    )
    max_step: float = setting(1.0, "distance from the flow, in shoulder widths, beyond which a step costs no more",
                                  low=0.01, high=100.0)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class ArmHypotheses:
    """K hypotheses of one arm in one image.

    `places` (K, 2, 2) px are elbow and wrist, `score` (K,) is in nats, higher is better, and `motion` (K, 2, 2) px is
    the flow of elbow and wrist to the next image.
    """

    places: F64
    score: F64
    motion: F64


def max_marginals(arms: Sequence[ArmHypotheses], width: float, settings: ArmPathSettings) -> list[F64]:
    """Return the cost (K,) of the best path through each hypothesis, for each of the T images; lower is better.

    The best path goes through the minimum of each image. `width` is the shoulder width in pixels.
    """
    steps = [step_costs(a, b, width, settings) for a, b in pairwise(arms)]
    forward = [-arms[0].score]
    for arm, step in zip(arms[1:], steps, strict=True):
        forward.append((forward[-1][:, None] + step).min(axis=0) - arm.score)
    backward = [np.zeros(len(arms[-1].score))]
    for arm, step in zip(arms[:0:-1], steps[::-1], strict=True):
        backward.append((step + backward[-1] - arm.score).min(axis=1))
    return [there + back for there, back in zip(forward, backward[::-1], strict=True)]


def step_costs(before: ArmHypotheses, after: ArmHypotheses, width: float, settings: ArmPathSettings) -> F64:
    """Return the costs (K, K') of the steps between the hypotheses of two images; `width` in pixels."""
    expected = before.places + before.motion
    distance = np.linalg.norm(expected[:, None] - after.places[None], axis=3) @ (JOINT_WEIGHTS / JOINT_WEIGHTS.sum())
    return np.asarray(settings.flow_strength * np.minimum(distance / width, settings.max_step))
