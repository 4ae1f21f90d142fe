# SPDX-License-Identifier: Apache-2.0
"""Errors of bodies that are tracked through colour and depth of people who move fast."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.settings import BodyTrackerSettings
from flowing_puppet_ros.evaluate.rgbd.keypoints import LIMB_JOINTS
from flowing_puppet_ros.evaluate.rgbd.methods import SensedScene, as_puppet
from flowing_puppet_ros.evaluate.rgbd.scores import MIN_LOST_M
from flowing_puppet_ros.evaluate.rgbd.sequences import FAST_M, draw_moving
from flowing_puppet_ros.evaluate.rgbd.views import RgbdFrame, RgbdStudio
from flowing_puppet_ros.fusion.people_fitter import FusionSettings, PeopleFitter
from flowing_puppet_ros.fusion.puppet_joints import MIN_PUPPET_JOINTS, PuppetJoints, carry_puppets
from flowing_puppet_ros.fusion.seen_cloud import SeenCloud
from flowing_puppet_ros.fusion.tracker import FusedTracker

HOLD_S = 2.0  # for which ids are held, as the node does


@dataclass(frozen=True, slots=True, eq=False)
class MotionScore:
    """One motion tracked at one rate.

    Attributes:
        rate: Hz.
        errors: (T, 12) m of LIMB_JOINTS in the world, NaN for those that are not in view or without a body.
        arms: (T,) bool, whether a seen elbow or wrist is off by more than 15 cm, or the body is missing.
        missing: (T,) bool, frames without a body of somebody of whom enough joints for a puppet are in view.
        seconds: (T,) processor time of every frame.
    """

    rate: float
    errors: np.ndarray
    arms: np.ndarray
    missing: np.ndarray
    seconds: np.ndarray


class _Runner:
    """One tracker that gets every `step`-th frame."""

    def __init__(self, fitter: BodyFitter, rate: float, step: int) -> None:
        self.rate, self.step = rate, step
        self._rows = [fitter.model.joint_names.index(name) for name in LIMB_JOINTS]
        self._tracker = FusedTracker(PeopleFitter(fitter, FusionSettings()), BodyTrackerSettings(), HOLD_S)
        self._errors: list[np.ndarray] = []
        self._arms: list[bool] = []
        self._missing: list[bool] = []
        self._seconds: list[float] = []

    def add(self, frame: RgbdFrame, seconds: float, later: Sequence[tuple[float, PuppetJoints]]) -> None:
        """Track the person into the depth image of a time, with the puppets known until shortly after."""
        scene = SensedScene.of(frame)
        started = time.process_time()
        puppets = _carry(later, seconds)
        bodies, _ = self._tracker.step(
            SeenCloud.of(scene.points, scene.colour), scene.image, puppets, round(seconds * 1e9)
        )
        self._seconds.append(time.process_time() - started)
        error, seen = np.full(len(LIMB_JOINTS), np.nan), frame.seen[0]
        if bodies:
            joints = bodies[0].fit.joints[self._rows] + scene.to_world[:3, 3]
            error[seen.in_view] = np.linalg.norm(joints - frame.joints[0], axis=1)[seen.in_view]
        arms = np.array([name.endswith(("elbow", "wrist")) for name in LIMB_JOINTS]) & seen.visible
        present = bool(np.count_nonzero(seen.in_view) >= MIN_PUPPET_JOINTS)
        self._errors.append(error)
        self._missing.append(present and not bodies)
        self._arms.append(present and (not bodies or bool((error[arms] > MIN_LOST_M).any())))

    def finish(self) -> MotionScore:
        """Return the errors of all frames."""
        errors = np.stack(self._errors)
        return MotionScore(self.rate, errors, np.array(self._arms), np.array(self._missing), np.array(self._seconds))


def track_motion(
    fitter: BodyFitter,
    studio: RgbdStudio,
    rng: np.random.Generator,
    rates: Sequence[float],
    seconds: float,
    lag: float = 0.0,
    noise: float = 5.0,
    min_speed: float = FAST_M,
) -> list[MotionScore]:
    """Track one person in a motion of the motion capture, at each of `rates` Hz, which divide the first.

    Arguments as for `draw_moving`.
    """
    fastest = max(rates)
    runners = [_Runner(fitter, rate, round(fastest / rate)) for rate in rates]
    puppets: list[tuple[float, PuppetJoints]] = []
    for index, frame in enumerate(draw_moving(studio, rng, seconds, fastest, min_speed, lag, noise)):
        now = index / fastest
        puppets.append((now + lag, as_puppet(fitter.model.joint_names, "p1", frame.keypoints[0])))
        for runner in runners:
            if index % runner.step == 0:
                own = [pair for k, pair in enumerate(puppets) if k % runner.step == 0]
                runner.add(frame, now, own[-4:])
    return [runner.finish() for runner in runners]


def _carry(puppets: Sequence[tuple[float, PuppetJoints]], seconds: float) -> list[PuppetJoints]:
    """Return the puppet of a time: between two of which it lies, or the nearest one."""
    before = [pair for pair in puppets if pair[0] <= seconds][-1:]
    after = [pair for pair in puppets if pair[0] >= seconds][:1]
    if not before or not after or before[0][0] == after[0][0]:
        return [(after or before)[0][1]]
    share = (seconds - before[0][0]) / (after[0][0] - before[0][0])
    return carry_puppets([before[0][1]], [after[0][1]], share)


def summarise_motions(scores: Sequence[MotionScore]) -> dict[str, float]:
    """Summarise the motions of one rate; centimetres and milliseconds."""
    errors = 100 * np.concatenate([score.errors for score in scores])
    wrists = [k for k, name in enumerate(LIMB_JOINTS) if name.endswith(("elbow", "wrist"))]
    return {
        "rate_hz": scores[0].rate,
        "motions": len(scores),
        "frames": len(errors),
        "joints_cm": float(np.nanmean(errors)),
        "arms_cm": float(np.nanmean(errors[:, wrists])),
        "arms_lost_percent": 100 * float(np.concatenate([score.arms for score in scores]).mean()),
        "longest_lost_s": max(_longest(score.arms) / score.rate for score in scores),
        "longest_missing_s": max(_longest(score.missing) / score.rate for score in scores),
        "ms_median": 1000 * float(np.median(np.concatenate([score.seconds for score in scores]))),
        "ms_mean": 1000 * float(np.mean(np.concatenate([score.seconds for score in scores]))),
    }


def _longest(flags: np.ndarray) -> int:
    """Return the length of the longest run of true flags (T,)."""
    longest = run = 0
    for flag in flags:
        run = run + 1 if flag else 0
        longest = max(longest, run)
    return longest
