# SPDX-License-Identifier: Apache-2.0
"""A bank of people who stand, walk and turn, drawn from the model, and how well each explains a candidate.

The soles are on the floor, so only the place and the yaw are free. What a few dozen points leave open, above all the
height, comes from the floor and from the bank, not from the points.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

import numpy as np

from flowing_puppet_ros.body.bank.body_bank import BodyBank, turn_bodies
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.process.threads import one_blas_thread

POSES, SHAPE_SCALE = 120, 0.7
MIN_STRAIGHT_KNEE_RAD, MIN_OTHER_KNEE_RAD = np.radians(140.0), np.radians(95.0)
MAX_TRUNK_TILT_RAD, MAX_STRIDE_M, MAX_BALANCE_M = np.radians(25.0), 0.6, 0.25
"""What makes a drawn body upright: knees, tilt of the trunk, distance of the ankles before each other and of the middle
between them from below the hips; hands below the neck."""
LEAN_RAD, LEAN_DEVIATION_RAD = np.radians(2.0), np.radians(7.0)
"""Lean of the trunk ahead, and its deviation ahead and to the sides, of people in motion capture who stand or walk; the
model draws all trunks upright."""
CHILD_TOP_M, CHILD_STATURES_M = 1.5, (1.05, 1.45)
"""Height of the top of a cloud over the floor up to which children are tried, too, and their statures."""


@lru_cache(maxsize=3)
@one_blas_thread()
def make_upright_bank(model: StitchedPuppet) -> BodyBank:
    """Draw the bank; made once for a model."""
    bodies: list[tuple[BodyState, np.ndarray]] = []
    for state, vertices in _draw_bodies(model, np.random.default_rng(0)):
        if len(bodies) == POSES:
            break
        joints = dict(zip(model.joint_names, model.joints(vertices), strict=True))
        if not _is_upright(joints):
            continue
        hips = (joints["left_hip"] + joints["right_hip"]) / 2
        down = np.array([-hips[0], -hips[1], -vertices[:, 2].min()])
        bodies.append((BodyState(state.center + down, state.rotation, state.pose, state.shape), vertices + down))
    return turn_bodies(model, bodies)


@lru_cache(maxsize=3)
@one_blas_thread()
def make_child_bank(model: StitchedPuppet) -> BodyBank:
    """Make children of the bank's adults: in the same poses, as small as the model can be made; once for a model.

    A stature is linear in the shape, so that the least unusual small shape is along its gradient.
    """
    adults = make_upright_bank(model)
    rest = model.rest_state().shape
    base, units = model.measure_height(rest), np.eye(rest.shape[1])
    slope = np.array([model.measure_height(rest + unit) - base for unit in units])
    wanted = np.linspace(*CHILD_STATURES_M, POSES)[np.random.default_rng(0).permutation(POSES)]
    bodies = []
    for state, stature, small in zip(adults.states, adults.stature, wanted, strict=True):
        shape = state.shape + (small - stature) * slope / (slope @ slope)
        child = BodyState(state.center * (small / stature), state.rotation, state.pose, shape)
        vertices = model.vertices(child)
        down = np.array([0.0, 0.0, -vertices[:, 2].min()])
        bodies.append((replace(child, center=child.center + down), vertices + down))
    return turn_bodies(model, bodies)


def _draw_bodies(model: StitchedPuppet, rng: np.random.Generator) -> Iterator[tuple[BodyState, np.ndarray]]:
    """Draw bodies and their vertices (V, 3) without end, many at a time, which takes a tenth of the time."""
    while True:
        bodies = model.sample_many(rng, POSES, shape_scale=SHAPE_SCALE)
        lean = LEAN_DEVIATION_RAD * rng.standard_normal((POSES, 3)) * [1.0, 1.0, 0.0] + [0.0, LEAN_RAD, 0.0]
        arrays = (bodies.center, bodies.rotation, bodies.pose, bodies.shape, model.vertices(bodies), so3.exp(lean))
        for center, rotation, pose, shape, vertices, turn in zip(*arrays, strict=True):
            yield BodyState(center @ turn.T, turn @ rotation, pose, shape), vertices @ turn.T


def _is_upright(joints: dict[str, np.ndarray]) -> bool:
    hips = (joints["left_hip"] + joints["right_hip"]) / 2
    neck = (joints["left_shoulder"] + joints["right_shoulder"]) / 2
    trunk = neck - hips
    knees = sorted(
        _bend(*(joints[f"{side}_{name}"] for name in ("hip", "knee", "ankle"))) for side in ("left", "right")
    )
    # The drawn body's torso faces along x, but its trunk need not be upright.
    stride = abs(joints["left_ankle"][0] - joints["right_ankle"][0])
    balance = (joints["left_ankle"] + joints["right_ankle"]) / 2 - hips
    hands = max(joints["left_wrist"][2], joints["right_wrist"][2])
    return bool(
        trunk[2] > np.cos(MAX_TRUNK_TILT_RAD) * np.linalg.norm(trunk)
        and knees[0] > MIN_OTHER_KNEE_RAD
        and knees[1] > MIN_STRAIGHT_KNEE_RAD
        and stride < MAX_STRIDE_M
        and np.hypot(*balance[:2]) < MAX_BALANCE_M
        and hands < neck[2]
    )


def _bend(above: np.ndarray, joint: np.ndarray, below: np.ndarray) -> float:
    """Return the angle at a joint, pi where it is straight."""
    a, b = above - joint, below - joint
    return float(np.arccos(np.clip(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)), -1, 1)))
