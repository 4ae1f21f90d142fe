# SPDX-License-Identifier: Apache-2.0
"""What joints cannot tell: where a rig stands in the world, and how large it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.multiview.camera import Camera

_TURN_DEG, _MOVE_M = 0.3, 0.02  # by which a camera that did not move may differ


def scale_to(cameras: Mapping[str, Camera], factor: float) -> dict[str, Camera]:
    """Return the cameras with all lengths multiplied by `factor`."""
    return {name: replace(each, translation=each.translation * factor) for name, each in cameras.items()}


def match_baselines(cameras: Mapping[str, Camera], former: Mapping[str, Camera]) -> float:
    """Return the factor by which lengths must be multiplied to have the former baselines: the median over pairs."""
    ratios = [
        np.linalg.norm(former[a].centre - former[b].centre) / np.linalg.norm(cameras[a].centre - cameras[b].centre)
        for a, b in combinations(cameras, 2)
    ]
    return float(np.median(ratios))


def place_as_before(cameras: Mapping[str, Camera], former: Mapping[str, Camera]) -> dict[str, Camera]:
    """Return the cameras in the world of the former ones: most of them stand where they stood.

    One that was moved or turned does not draw the others along, since the loss is robust.
    """
    names = list(cameras)
    turned = np.stack([cameras[name].rotation for name in names])
    centres = np.stack([cameras[name].centre for name in names])
    old_turned = np.stack([former[name].rotation for name in names])
    old_centres = np.stack([former[name].centre for name in names])
    starts = np.einsum("cji,cjk->cik", old_turned, turned)  # each camera's own idea of the rotation

    def residuals(values: F64) -> F64:
        world = Rotation.from_rotvec(values[:3]).as_matrix()
        turns = Rotation.from_matrix(np.einsum("cij,kj,clk->cil", turned, world, np.swapaxes(old_turned, 1, 2)))
        moves = centres @ world.T + values[3:] - old_centres
        return np.concatenate([np.degrees(turns.as_rotvec()).ravel() / _TURN_DEG, moves.ravel() / _MOVE_M])

    best = None
    for start in starts:
        guess = np.concatenate(
            [Rotation.from_matrix(start).as_rotvec(), np.median(old_centres - centres @ start.T, axis=0)]
        )
        found = least_squares(residuals, guess, loss="cauchy")
        if best is None or found.cost < best.cost:
            best = found
    assert best is not None
    world, moved = Rotation.from_rotvec(best.x[:3]).as_matrix(), best.x[3:]
    return {name: each.move(world, moved) for name, each in cameras.items()}
