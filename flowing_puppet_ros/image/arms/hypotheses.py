# SPDX-License-Identifier: Apache-2.0
"""Hypotheses of the arms of the people in a clip: the detector's, and their neighbours' in time carried by the flow.

Each hypothesis is judged in its own image, by the detector's max-marginals and by contour and colour; which is true is
decided at the end of the clip, by `arm_path`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.flow.estimate import FlowPair
from flowing_puppet_ros.image.arms.evidence import ARM_JOINTS, ArmEvidence
from flowing_puppet_ros.image.arms.viterbi import ArmHypotheses, PathSettings, max_marginals, step_costs
from flowing_puppet_ros.image.tracking.propagation import ImageScale
from flowing_puppet_ros.image.tracking.smoothing import flow_at_joints, sample_flow

SIDES = ("right", "left")
MAX_PROPAGATED = 3  # hypotheses of a neighbouring image that are carried into this one
MAX_KEPT, MIN_DISTANCE = 8, 0.2
"""Live more are carried, since one that is dropped is lost; and only such as differ by so many shoulder widths at elbow
or wrist, since the best ones often are one and the same."""
NEAR = 0.35  # shoulder widths within which hypotheses of the wrist agree
DOUBT = 2.0  # nats, cost difference at which a path counts 1/e of the best
RIGHT = np.array([[-0.07, 0.10, 0.23], [-0.51, 0.23, 0.26]])
"""Log-odds that elbow and wrist lie within 20 px of a 320x240 image's true place: a constant, and by the scores of the
arm and of the whole pose. Logistic regression over the live and batch tracks of 31 annotated clips."""


@dataclass(frozen=True, slots=True, eq=False)
class ArmTrajectory:
    """Elbow and wrist over T images.

    `places` (T, 2, 2) px, `motion` (T, 2, 2) px to the next, `sure` (T,) how clearly they beat other paths, 0 to 1, and
    `right` (T, 2) probability that they are in place, NaN where nobody was detected.
    """

    places: F64
    motion: F64
    sure: F64
    right: F64


@dataclass(slots=True, eq=False)
class ArmSmoother:
    """Hypotheses of both arms of one person over consecutive images."""

    settings: PathSettings
    _arms: dict[str, list[ArmHypotheses]] = field(default_factory=lambda: {side: [] for side in SIDES})
    _poses: list[float] = field(default_factory=list)
    _last: ArmEvidence | None = None

    def add(self, sight: ArmEvidence, flow: FlowPair | None, grid: ImageScale) -> None:
        """Take the next image; `flow` (forward, backward) leads to it from the one before, on the working grid."""
        for side in SIDES:
            arms = self._arms[side]
            own = sight.hypotheses(side, self.settings.modes)
            if arms and flow is not None and self._last is not None:
                arms[-1] = self._extended(arms[-1], side, own, flow, grid)
                own = np.concatenate([own, _best(arms[-1])])
            score = sight.score(side, own, self.settings)
            arms.append(ArmHypotheses(own, score, np.zeros_like(own)))
        self._poses.append(sight.pose_score)
        self._last = sight

    def _extended(
        self, before: ArmHypotheses, side: str, after: F64, flow: FlowPair, grid: ImageScale
    ) -> ArmHypotheses:
        """The image before with the best of this image carried back into it, and everybody's motion."""
        assert self._last is not None
        motion = _motion(flow, grid, before.places)
        source = after[:MAX_PROPAGATED]
        back = source + _motion((flow[1], flow[0]), grid, source)
        score = self._last.score(side, back, self.settings)
        return ArmHypotheses(
            np.concatenate([before.places, back]),
            np.concatenate([before.score, score]),
            np.concatenate([motion, source - back]),
        )

    def resolve(self, width: float) -> dict[str, ArmTrajectory]:
        """The best path of each arm; `width` is the shoulder width in pixels."""
        return {side: _resolved(arms, self._poses, width, self.settings) for side, arms in self._arms.items() if arms}


@dataclass(slots=True, eq=False)
class ArmFilter:
    """The arms of one person live: of every hypothesis the cost of the best path that leads there, nothing older."""

    settings: PathSettings
    _arms: dict[str, ArmHypotheses] = field(default_factory=dict)
    _images: int = 0

    def propagate(self, flow: FlowPair | None, grid: ImageScale) -> None:
        """Go on to the next image, whether anybody looks there or not.

        `flow` (forward, backward) leads there, on the working grid; without one nothing before that image counts.
        """
        if flow is None:
            self._arms.clear()
        else:
            self.predict(lambda places: places + _motion(flow, grid, places), 1)

    def predict(self, moved: Callable[[F64], F64], images: int) -> None:
        """Go `images` on, where `moved` takes places (K, 2, 2) px of this image."""
        self._images += images
        self._arms = {side: replace(arm, places=moved(arm.places)) for side, arm in self._arms.items()}

    def step(self, sight: ArmEvidence) -> dict[str, tuple[F64, F64]]:
        """Elbow and wrist (2, 2) px of each arm in this image, and the probabilities (2,) that they are right.

        NaN where nobody was detected.
        """
        # What the flow errs adds up from image to image.
        settings = replace(self.settings, flow_strength=self.settings.flow_strength / max(1, self._images))
        self._images = 0
        return {side: self._side(side, sight, settings) for side in SIDES}

    def joints(self, sight: ArmEvidence) -> dict[int, tuple[F64, float]]:
        """The same by the joints' indices in the model: place (2,) px and probability of each."""
        names = sight.model.joint_names
        return {
            names.index(f"{side}_{name}"): (ends[k], float(right[k]))
            for side, (ends, right) in self.step(sight).items()
            for k, name in enumerate(ARM_JOINTS)
        }

    def _side(self, side: str, sight: ArmEvidence, settings: PathSettings) -> tuple[F64, F64]:
        before, places = self._arms.get(side), sight.hypotheses(side, settings.modes)
        if before is not None:
            places = np.concatenate([places, _distinct(before, sight.width)])
        score = own = sight.score(side, places, settings)
        if before is not None:
            now = ArmHypotheses(places, own, np.zeros_like(places))
            score = own + (before.score[:, None] - step_costs(before, now, sight.width, settings)).max(axis=0)
        arm = ArmHypotheses(places, score - score.max(), np.zeros_like(places))
        self._arms[side] = arm
        best = int(score.argmax())
        return places[best], joint_correctness(float(own[best]), sight.pose_score)


def joint_correctness(score: float, pose_score: float) -> F64:
    """Probabilities (2,) that elbow and wrist of an arm are right, by its score and the pose's."""
    return np.asarray(1 / (1 + np.exp(-RIGHT @ np.array([1.0, score, pose_score]))))


def _resolved(
    arms: Sequence[ArmHypotheses], poses: Sequence[float], width: float, settings: PathSettings
) -> ArmTrajectory:
    places, motion, sure, right = [], [], [], []
    for arm, pose, cost in zip(arms, poses, max_marginals(arms, width, settings), strict=True):
        best, certainty = _surest(arm, cost, width)
        places.append(arm.places[best])
        motion.append(arm.motion[best])
        sure.append(certainty)
        right.append(joint_correctness(float(arm.score[best]), pose))
    return ArmTrajectory(np.array(places), np.array(motion), np.array(sure), np.array(right))


def _surest(arm: ArmHypotheses, cost: F64, width: float) -> tuple[int, float]:
    """The hypothesis of least cost (K,), and how sure it is (0 to 1)."""
    best = int(cost.argmin())
    weight = np.exp((cost[best] - cost) / DOUBT)
    near = np.linalg.norm(arm.places[:, 1] - arm.places[best, 1], axis=1) < NEAR * width
    # Hypotheses in one place are one: of each place the best counts.
    return best, 1.0 / (1.0 + float(weight[~near].max(initial=0.0)))


def _best(arm: ArmHypotheses) -> F64:
    """The best hypotheses (up to CARRIED, 2, 2) where the flow takes them."""
    order = np.argsort(-arm.score, kind="stable")[:MAX_PROPAGATED]
    return np.asarray(arm.places[order] + arm.motion[order])


def _distinct(arm: ArmHypotheses, width: float) -> F64:
    """The best hypotheses (up to KEPT, 2, 2) that differ."""
    kept: list[int] = []
    for k in np.argsort(-arm.score, kind="stable").tolist():
        apart = np.linalg.norm(arm.places[kept] - arm.places[k], axis=2).max(axis=1)
        if (apart >= MIN_DISTANCE * width).all():
            kept.append(k)
        if len(kept) == MAX_KEPT:
            break
    return arm.places[kept]


def _motion(flow: FlowPair, grid: ImageScale, places: F64) -> F64:
    """How far the flow takes places (K, 2, 2)."""
    flat = places.reshape(-1, 2)
    ahead = np.nan_to_num(sample_flow(flow[0], grid.to_work(flat))) / grid.factor
    moved, _ = flow_at_joints(flow, grid, flat, flat + ahead)
    return moved.reshape(places.shape)
