# SPDX-License-Identifier: Apache-2.0
"""What a track knows of a person after a cloud, and where the person should be in the next."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.body.refine.gauss_newton import GaussNewton, RefineWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.model.sp import BodyState

MAX_STRETCH = 2.0  # frames by which a motion is extrapolated at most
FIRST_GAP_NS = 150_000_000  # time after the first frame up to which somebody is taken to be where they were
ALIGNED = RefineWeights(stitch=1.0, pose=1e-5, shape=1e-2, pairwise=1e-5, sigma_start=0.4, sigma_end=0.08, iterations=6)
"""To joints alone, the shape being known."""
LONG_GAP_NS = 250_000_000  # time between clouds from which on the middle of the cloud tells better where somebody went
VISIBLE_HALF_LIFE_S = 2.0  # in which the normal visible surface falls to half where less is seen


@dataclass(frozen=True, slots=True, eq=False)
class BodyObservation:
    """A fit, the time of its cloud in nanoseconds, the mean (3,) of the cloud's points, metres, and their number."""

    fit: BodyFit
    stamp: int
    middle: F64
    points: int


@dataclass(frozen=True, slots=True, eq=False)
class TrackState:
    """What is known of the person after a cloud.

    `best` two-way distance in metres since the last full fit, of a cloud of `best_points`, `frames` whose shape was
    learned, `visible` surface that is normally seen (points times squared metres of distance), `lost`: the body is not
    where the person is.
    """

    before: BodyObservation | None = None
    last: BodyObservation | None = None
    best: float = np.inf
    best_points: int = 0
    frames: int = 0
    visible: float = 0.0
    hidden: bool = False
    lost: bool = True

    def predict(self, stamp: int, middle: F64, max_gap_s: float) -> BodyState | None:
        """Return the last body, moved on by its last motion in proportion to the time; None without one.

        Without a motion, and after a long gap, which a full fit leaves in a live stream too, it moves as the middle of
        the cloud did; after a shorter one, it turns by its last motion.

        Args:
            stamp: of the next cloud, nanoseconds.
            middle: (3,) metres, mean of its points.
            max_gap_s: seconds from the last cloud beyond which its motion tells nothing.
        """
        last = self.last
        if last is None:
            return None
        if stamp - last.stamp > 1e9 * max_gap_s or is_far(self.before, last, stamp):
            return replace(last.fit.state, center=last.fit.state.center + middle - last.middle)
        moved = extrapolate(self.before, last, stamp)
        if stamp - last.stamp <= LONG_GAP_NS:
            return moved
        return replace(moved, center=moved.center + middle - last.middle - (moved.center[0] - last.fit.state.center[0]))

    def see(self, points: F64, stamp: int, viewpoint: F64, min_visible: float) -> TrackState:
        """Return the state after a look at the person's points (N, 3) m from `viewpoint` (3,) m.

        The person is hidden when less than a share `min_visible` is seen than normally; what is normal follows what is
        seen.
        """
        seen = len(points) * float(((points - viewpoint) ** 2).sum(axis=1).mean())
        passed = 0.0 if self.last is None else 1e-9 * (stamp - self.last.stamp)
        visible = max(seen, self.visible * 0.5 ** (passed / VISIBLE_HALF_LIFE_S))
        return replace(self, visible=visible, hidden=seen < min_visible * visible)


def is_far(before: BodyObservation | None, last: BodyObservation, stamp: int) -> bool:
    """Return whether a time in nanoseconds is farther from the last one than the last motion, if any, tells about."""
    known = FIRST_GAP_NS if before is None else MAX_STRETCH * (last.stamp - before.stamp)
    return stamp - last.stamp > known


def extrapolate(before: BodyObservation | None, last: BodyObservation, stamp: int) -> BodyState:
    """Return the last body, moved on by its last motion in proportion to the time."""
    state = last.fit.state
    if before is None:
        return state
    share = _stretch(before, last, stamp)
    turn = rotation.log(np.swapaxes(before.fit.state.rotation, -1, -2) @ state.rotation)
    return replace(
        state,
        center=state.center + share * (state.center - before.fit.state.center),
        rotation=state.rotation @ rotation.exp(share * turn),
    )


def translate(before: BodyObservation | None, last: BodyObservation, stamp: int) -> BodyState:
    """Return the last body, moved on as its torso moved, in the pose that it has."""
    state = last.fit.state
    if before is None:
        return state
    moved = state.center[0] - before.fit.state.center[0]
    return replace(state, center=state.center + _stretch(before, last, stamp) * moved)


def align(refiner: GaussNewton, body: BodyState, places: JointTargets) -> BodyState:
    """Return the body of the same shape whose joints lie at `places` as well as they can, in a few milliseconds."""
    return refiner.run(body, None, places, replace(ALIGNED, shape_center=body.shape.mean(axis=0)))


def _stretch(before: BodyObservation, last: BodyObservation, stamp: int) -> float:
    """Return by how many frames the last motion is extrapolated."""
    return min((stamp - last.stamp) / (last.stamp - before.stamp), MAX_STRETCH)
