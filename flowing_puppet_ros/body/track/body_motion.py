# SPDX-License-Identifier: Apache-2.0
"""Where a tracked body should be at the time of the next cloud, by its last motion or by joints that somebody sees."""

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
ALIGNED = RefineWeights(stitch=1.0, pose=1e-5, shape=1e-2, pairwise=1e-5, sigma_start=0.4, sigma_end=0.08, iterations=6)
"""To joints alone, the shape being known."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyObservation:
    """A fit, the time of its cloud in nanoseconds, and the mean (3,) of the cloud's points, metres."""

    fit: BodyFit
    stamp: int
    middle: F64


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
