# SPDX-License-Identifier: Apache-2.0
"""How well the joints tell where each camera looks: the Cramer-Rao bound of its turn and place.

Errors of joints are no noise: a network is off the same way in image after image. How often an error is the same is
measured by the correlation of what remains, and that many instants count as one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.multiview.bundle.adjustment import (
    MOVE_M,
    ROBUST_PX,
    ROLL,
    TURN,
    CameraState,
    choose_instants,
    eliminate_joints,
    measure_residuals,
    reweight,
    triangulate_linear,
)
from flowing_puppet_ros.multiview.bundle.joint_tracks import PeopleTracks
from flowing_puppet_ros.multiview.camera import Camera


@dataclass(frozen=True, slots=True)
class PoseUncertainty:
    """Standard deviations that no estimate from these joints can beat, if all other cameras are right.

    Attributes:
        turn: of the camera's axis, degrees.
        roll: about its axis, degrees.
        move: of its place, m.
    """

    turn: float
    roll: float
    move: float


def bound_uncertainty(
    cameras: Mapping[str, Camera], offsets: Mapping[str, float], tracks: PeopleTracks
) -> dict[str, PoseUncertainty]:
    """Return the bound of each camera's pose, given that it was known as `adjust` expects before."""
    instants = choose_instants(tracks, list(cameras))
    start = np.array([offsets.get(name, 0.0) for name in cameras])
    state = CameraState.of(list(cameras.values()), start)
    focal = np.array([camera.focal for camera in cameras.values()])
    plane, confidence = instants.observe(start)
    weight = reweight(state, plane, confidence, ROBUST_PX / 1000.0)
    used = (weight > 0).sum(axis=0) >= 2
    points = triangulate_linear(state.rotation, state.translation, plane, weight)
    error = np.where((weight > 0)[..., None] & used[:, None], 1.0, 0.0) * focal[:, None, None]
    error = error * measure_residuals(state.rotation, state.translation, plane, points)
    views = (weight[:, used] > 0).sum(axis=0)
    # Each joint has taken three of the coordinates that its views have.
    freedom = float((2 * views - 3).sum() / (2 * views).sum())
    variance = float((weight[..., None] * error**2).sum() / (2 * weight[:, used].sum())) / freedom
    series = error.reshape(len(focal), len(tracks.tracks), len(instants.times), len(tracks.names), 2)
    same = _count_same(np.sqrt(weight).reshape(series.shape[:-1])[..., None] * series)
    scaled = weight[:, used] * focal[:, None] ** 2 / (variance * same)
    normal, _ = eliminate_joints(state, plane[:, used], np.zeros((len(focal), int(used.sum()), 2)), scaled)
    size = len(normal) // len(focal)
    known = np.diag(1 / np.array([TURN, TURN, ROLL, MOVE_M, MOVE_M, MOVE_M]) ** 2)
    found = {}
    for k, name in enumerate(cameras):
        own = normal[k * size : k * size + 6, k * size : k * size + 6]
        deviation = np.sqrt(np.diag(np.linalg.inv(own + known)))
        turn, roll = float(np.hypot(*deviation[:2])), float(deviation[2])
        found[name] = PoseUncertainty(
            float(np.degrees(turn)), float(np.degrees(roll)), float(np.linalg.norm(deviation[3:]))
        )
    return found


def _count_same(series: F64) -> float:
    """Return how many successive instants have the same error, of errors (C, P, M, J, 2), 0 where unknown.

    The sum of the correlations of instants that are so far apart, with what stays the same throughout in it.
    """
    count = series.shape[2]
    power = (series**2).sum()
    if not power:
        return 1.0
    lags = [2 * float((series[:, :, lag:] * series[:, :, :-lag]).sum()) / power for lag in range(1, count)]
    return max(1.0, 1.0 + sum(lags))
