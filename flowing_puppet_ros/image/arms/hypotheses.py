# SPDX-License-Identifier: Apache-2.0
"""Hypotheses of a person's arms over time: the detector's, and those propagated by the flow from neighbouring images.

Each hypothesis is scored in its own image, by the detector's max-marginals and by contour and colour. `ArmSmoother`
chooses among them at the end of a clip, by `viterbi`; `ArmFilter` chooses in every image.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.flow.estimate import FlowPair
from flowing_puppet_ros.image.arms.evidence import ARM_JOINTS, ArmEvidence
from flowing_puppet_ros.image.arms.viterbi import ArmHypotheses, ArmPathSettings, max_marginals, step_costs
from flowing_puppet_ros.image.tracking.propagation import ImageScale
from flowing_puppet_ros.image.tracking.smoothing import flow_at_joints, sample_flow

SIDES = ("right", "left")
MAX_PROPAGATED = 3  # hypotheses propagated from a neighbouring image
MAX_LIVE, MIN_DISTINCT_WIDTHS = 8, 0.2
"""Live mode keeps more hypotheses, since dropped ones cannot return, and only distinct ones: at least so many shoulder
widths apart at elbow or wrist."""
SAME_WRIST_WIDTHS = 0.35  # shoulder widths within which hypotheses of the wrist agree
PATH_TEMPERATURE_NATS = 2.0  # cost difference at which a path counts 1/e of the best
CORRECTNESS_WEIGHTS = np.array([[-0.07, 0.10, 0.23], [-0.51, 0.23, 0.26]])
"""Weights of the log odds that elbow and wrist lie within 20 px of the truth in a 320x240 image: a constant, the score
of the arm and that of the whole pose. Logistic regression over the live and batch tracks of 31 annotated clips."""


@dataclass(frozen=True, slots=True, eq=False)
class ArmTrajectory:
    """Elbow and wrist over T images.

    `places` (T, 2, 2) px, `motion` (T, 2, 2) px to the next image, `certainty` (T,) in [0, 1] of the choice of path,
    `correctness` (T, 2), the probability that each joint is right, NaN where the person was missed.
    """

    places: F64
    motion: F64
    certainty: F64
    correctness: F64


@dataclass(slots=True, eq=False)
class ArmSmoother:
    """Hypotheses of both arms of one person over consecutive images."""

    settings: ArmPathSettings
    _arms: dict[str, list[ArmHypotheses]] = field(default_factory=lambda: {side: [] for side in SIDES})
    _poses: list[float] = field(default_factory=list)
    _last: ArmEvidence | None = None

    def add(self, evidence: ArmEvidence, flow: FlowPair | None, grid: ImageScale) -> None:
        """Add the next image; `flow` (forward, backward) leads to it from the one before, on the working grid."""
        for side in SIDES:
            arms = self._arms[side]
            own = evidence.hypotheses(side, self.settings.modes)
            if arms and flow is not None and self._last is not None:
                arms[-1] = self._extend_backward(arms[-1], side, own, flow, grid)
                own = np.concatenate([own, _propagate_best(arms[-1])])
            score = evidence.score(side, own, self.settings)
            arms.append(ArmHypotheses(own, score, np.zeros_like(own)))
        self._poses.append(evidence.pose_score)
        self._last = evidence

    def _extend_backward(
        self, before: ArmHypotheses, side: str, after: F64, flow: FlowPair, grid: ImageScale
    ) -> ArmHypotheses:
        """Return the hypotheses `before`, with motions, and the best of `after` propagated back into that image."""
        assert self._last is not None
        motion = _measure_motion(flow, grid, before.places)
        source = after[:MAX_PROPAGATED]
        back = source + _measure_motion((flow[1], flow[0]), grid, source)
        score = self._last.score(side, back, self.settings)
        return ArmHypotheses(
            np.concatenate([before.places, back]),
            np.concatenate([before.score, score]),
            np.concatenate([motion, source - back]),
        )

    def resolve(self, width: float) -> dict[str, ArmTrajectory]:
        """Return the best path of each arm; `width` is the shoulder width in pixels."""
        return {
            side: _resolve_arm(arms, self._poses, width, self.settings) for side, arms in self._arms.items() if arms
        }


@dataclass(slots=True, eq=False)
class ArmFilter:
    """Forward pass over the arms of one person: it keeps each hypothesis with the score of the best path to it."""

    settings: ArmPathSettings
    _arms: dict[str, ArmHypotheses] = field(default_factory=dict)
    _images: int = 0

    def propagate(self, flow: FlowPair | None, grid: ImageScale) -> None:
        """Propagate the hypotheses to the next image, with or without a detection there.

        `flow` (forward, backward) leads there, on the working grid; without one, the past is dropped.
        """
        if flow is None:
            self._arms.clear()
        else:
            self.predict(lambda places: places + _measure_motion(flow, grid, places), 1)

    def predict(self, warp: Callable[[F64], F64], images: int) -> None:
        """Advance by `images` images; `warp` moves positions (K, 2, 2) px of this image there."""
        self._images += images
        self._arms = {side: replace(arm, places=warp(arm.places)) for side, arm in self._arms.items()}

    def step(self, evidence: ArmEvidence) -> dict[str, tuple[F64, F64]]:
        """Score this image; return each arm's elbow and wrist (2, 2) px, and their probabilities (2,) of being right.

        The probabilities are NaN if the person was missed.
        """
        # Errors of the flow add up from image to image.
        settings = replace(self.settings, flow_strength=self.settings.flow_strength / max(1, self._images))
        self._images = 0
        return {side: self._step_side(side, evidence, settings) for side in SIDES}

    def step_joints(self, evidence: ArmEvidence) -> dict[int, tuple[F64, float]]:
        """Do a `step`; return by joint index of the model the position (2,) px and the probability of each."""
        names = evidence.model.joint_names
        return {
            names.index(f"{side}_{name}"): (arm[k], float(correctness[k]))
            for side, (arm, correctness) in self.step(evidence).items()
            for k, name in enumerate(ARM_JOINTS)
        }

    def _step_side(self, side: str, evidence: ArmEvidence, settings: ArmPathSettings) -> tuple[F64, F64]:
        before, places = self._arms.get(side), evidence.hypotheses(side, settings.modes)
        width = evidence.shoulder_width_px
        if before is not None:
            places = np.concatenate([places, _select_distinct(before, width)])
        score = own = evidence.score(side, places, settings)
        if before is not None:
            now = ArmHypotheses(places, own, np.zeros_like(places))
            score = own + (before.score[:, None] - step_costs(before, now, width, settings)).max(axis=0)
        arm = ArmHypotheses(places, score - score.max(), np.zeros_like(places))
        self._arms[side] = arm
        best = int(score.argmax())
        return places[best], joint_correctness(float(own[best]), evidence.pose_score)


def joint_correctness(score: float, pose_score: float) -> F64:
    """Return the probabilities (2,) that elbow and wrist of an arm are right, by its score and the pose's."""
    return np.asarray(1 / (1 + np.exp(-CORRECTNESS_WEIGHTS @ np.array([1.0, score, pose_score]))))


def _resolve_arm(
    arms: Sequence[ArmHypotheses], poses: Sequence[float], width: float, settings: ArmPathSettings
) -> ArmTrajectory:
    places, motion, certainty, correctness = [], [], [], []
    for arm, pose, cost in zip(arms, poses, max_marginals(arms, width, settings), strict=True):
        best, certain = _pick_best(arm, cost, width)
        places.append(arm.places[best])
        motion.append(arm.motion[best])
        certainty.append(certain)
        correctness.append(joint_correctness(float(arm.score[best]), pose))
    return ArmTrajectory(np.array(places), np.array(motion), np.array(certainty), np.array(correctness))


def _pick_best(arm: ArmHypotheses, cost: F64, width: float) -> tuple[int, float]:
    """Return the hypothesis of minimum `cost` (K,), and its certainty in [0, 1]."""
    best = int(cost.argmin())
    weight = np.exp((cost[best] - cost) / PATH_TEMPERATURE_NATS)
    near = np.linalg.norm(arm.places[:, 1] - arm.places[best, 1], axis=1) < SAME_WRIST_WIDTHS * width
    # Hypotheses with nearly the same wrist support each other: only others reduce the certainty.
    return best, 1.0 / (1.0 + float(weight[~near].max(initial=0.0)))


def _propagate_best(arm: ArmHypotheses) -> F64:
    """Return the best hypotheses (up to MAX_PROPAGATED, 2, 2) where the flow takes them."""
    order = np.argsort(-arm.score, kind="stable")[:MAX_PROPAGATED]
    return np.asarray(arm.places[order] + arm.motion[order])


def _select_distinct(arm: ArmHypotheses, width: float) -> F64:
    """Return the best distinct hypotheses (up to MAX_LIVE, 2, 2)."""
    kept: list[int] = []
    for k in np.argsort(-arm.score, kind="stable").tolist():
        distance = np.linalg.norm(arm.places[kept] - arm.places[k], axis=2).max(axis=1)
        if (distance >= MIN_DISTINCT_WIDTHS * width).all():
            kept.append(k)
        if len(kept) == MAX_LIVE:
            break
    return arm.places[kept]


def _measure_motion(flow: FlowPair, grid: ImageScale, places: F64) -> F64:
    """Return the motion (K, 2, 2) px of `places` (K, 2, 2) px by the flow."""
    flat = places.reshape(-1, 2)
    ahead = np.nan_to_num(sample_flow(flow[0], grid.to_work(flat))) / grid.factor
    moved, _ = flow_at_joints(flow, grid, flat, flat + ahead)
    return moved.reshape(places.shape)
