# SPDX-License-Identifier: Apache-2.0
"""A bank of people who stand, walk and turn, drawn from the model, and how well each explains a candidate.

The soles are on the floor, so only the place and the yaw are free. What a few dozen points leave open, above all the
height, comes from the floor and from the bank, not from the points.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from flowing_puppet_ros.body.cloud.mesh_geometry import farthest_points, vertex_normals
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.evidence.cloud.one_sided import distances
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.process.threads import one_blas_thread

POSES, YAWS, SHAPE_SCALE = 120, 16, 0.7
MIN_STRAIGHT_KNEE_RAD, MIN_OTHER_KNEE_RAD = np.radians(140.0), np.radians(95.0)
MAX_TRUNK_TILT_RAD, MAX_STRIDE_M, MAX_BALANCE_M = np.radians(25.0), 0.6, 0.25
"""What makes a drawn body upright: knees, tilt of the trunk, distance of the ankles before each other and of the middle
between them from below the hips; hands below the neck."""
LEAN_RAD, LEAN_DEVIATION_RAD = np.radians(2.0), np.radians(7.0)
"""Lean of the trunk ahead, and its deviation ahead and to the sides, of people in motion capture who stand or walk; the
model draws all trunks upright."""
MEAN_STATURE_M, STATURE_DEVIATION_M, STATURE_COST_M = 1.72, 0.1, 0.002
"""Statures of people, and the mean distance that one squared deviation from them is worth."""
MAX_DEVIATIONS = 3.0  # of a stature, beyond which it costs no more
CHILD_TOP_M, CHILD_STATURES_M = 1.5, (1.05, 1.45)
"""Height of the top of a cloud over the floor up to which children are tried, too, and their statures."""
ROUGH_POINTS, FINE_POINTS = 90, 300  # surface points of a body
ROUGH_TARGETS, FINE_TARGETS = 60, 250  # of the cloud
FINE_BODIES, MAX_SAME_YAW = 96, 2
TURNED = 3  # of the best bodies, that face the other way than the best
SEEN_MARGIN_M = 0.08  # above and below a cloud within which a body's surface is taken for seen


@dataclass(frozen=True, slots=True, eq=False)
class UprightBank:
    """Upright bodies of one model; row = yaw * POSES + pose.

    Attributes:
        states: POSES bodies that face along x, hips at x = y = 0, soles at z = 0.
        turns: (YAWS, 3, 3).
        points: (YAWS * POSES, FINE_POINTS, 3) m, so ordered that the first are spread evenly.
        normals: (YAWS * POSES, FINE_POINTS, 3).
        stature: (POSES,) metres.
    """

    states: list[BodyState]
    turns: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    stature: np.ndarray

    def find_best(
        self,
        cloud: SingleViewCloud,
        floor: float,
        count: int,
        facing: np.ndarray | None = None,
        every: int = 1,
    ) -> list[tuple[float, BodyState]]:
        """Return the best bodies on a cloud with their costs in metres, at most two of a yaw and `count` of all.

        A few of them face the other way than the best: few points hardly tell front from back, and only the refined
        bodies show which it is. `floor` is z of the floor, metres. Where it is known to which side, `facing` (2,), all
        face there. Of the poses and of the yaws, one out of `every` so many is compared.
        """
        rows = np.arange(len(self.points)).reshape(YAWS, POSES)[::every, ::every].ravel()
        if facing is not None:
            rows = rows[(self.turns[:, :2, 0] @ facing > 0)[rows // POSES]]
        targets = cloud.points[farthest_points(cloud.points, FINE_TARGETS)]
        rough, _ = self._judge(cloud, floor, rows, targets[:ROUGH_TARGETS], ROUGH_POINTS)
        rows = rows[np.argsort(rough, kind="stable")[:FINE_BODIES]]
        cost, shift = self._judge(cloud, floor, rows, targets, FINE_POINTS)
        order = np.argsort(cost, kind="stable")
        yaw = rows // POSES
        apart = np.abs((yaw - yaw[order[0]] + YAWS // 2) % YAWS - YAWS // 2) * (2 * np.pi / YAWS)
        first = _take_of_each_yaw(order, yaw, count - TURNED)
        turned = [k for k in first if apart[k] > np.pi / 2]
        others = [k for k in order if apart[k] > np.pi / 2 and k not in first]
        chosen = [*first, *_take_of_each_yaw(np.array(others, dtype=np.int64), yaw, max(TURNED - len(turned), 0))]
        return [
            (float(cost[k]), _place(self.states[rows[k] % POSES], self.turns[yaw[k]], shift[k]))
            for k in sorted(chosen, key=lambda k: float(cost[k]))
        ]

    def _judge(
        self, cloud: SingleViewCloud, floor: float, rows: np.ndarray, targets: np.ndarray, surface: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the costs (P,) m of bodies moved to the cloud, and by how much (P, 3) m they were moved."""
        points, normals = self.points[rows, :surface], self.normals[rows, :surface]
        middle = targets.mean(axis=0)
        low, high = targets[:, 2].min() - floor - SEEN_MARGIN_M, targets[:, 2].max() - floor + SEEN_MARGIN_M
        seen = (normals @ (middle - cloud.view.viewpoint) < 0) & (points[:, :, 2] > low) & (points[:, :, 2] < high)
        sums = (points[:, :, :2] * seen[:, :, None]).sum(axis=1)
        shift = np.full((len(rows), 3), floor)
        shift[:, :2] = middle[:2] - sums / np.maximum(seen.sum(axis=1), 1)[:, None]
        moved = points + shift[:, None, :]
        misfit, facing = cloud.view.misfit(moved, normals)
        cost = distances(targets, moved, facing).mean(axis=1) + misfit
        return cost + stature_cost(self.stature)[rows % POSES], shift


def _take_of_each_yaw(order: np.ndarray, yaw: np.ndarray, count: int) -> list[int]:
    """Return the first of an order (K,), at most `count`, and two of a yaw."""
    chosen: list[int] = []
    for k in order:
        if len(chosen) < count and sum(yaw[other] == yaw[k] for other in chosen) < MAX_SAME_YAW:
            chosen.append(int(k))
    return chosen


def stature_cost(stature: np.ndarray) -> np.ndarray:
    """Return the cost (P,) m of statures (P,) m; beyond adults', children are as likely as one another."""
    return STATURE_COST_M * np.minimum(((stature - MEAN_STATURE_M) / STATURE_DEVIATION_M) ** 2, MAX_DEVIATIONS**2)


@lru_cache(maxsize=3)
@one_blas_thread()
def make_upright_bank(model: StitchedPuppet) -> UprightBank:
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
    return _turn_bodies(model, bodies)


@lru_cache(maxsize=3)
@one_blas_thread()
def make_child_bank(model: StitchedPuppet) -> UprightBank:
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
    return _turn_bodies(model, bodies)


def _turn_bodies(model: StitchedPuppet, bodies: list[tuple[BodyState, np.ndarray]]) -> UprightBank:
    """Make a bank of bodies that face along x and their vertices (V, 3) m."""
    rows = farthest_points(model.vertices(model.rest_state()), FINE_POINTS)
    points, normals, statures = [], [], []
    for state, vertices in bodies:
        points.append(vertices[rows])
        normals.append(vertex_normals(vertices, model.faces)[rows])
        statures.append(model.measure_height(state.shape))
    turns = so3.exp(np.array([0.0, 0.0, 2 * np.pi / YAWS]) * np.arange(YAWS)[:, None])
    turned = [np.concatenate([np.stack(each) @ turn.T for turn in turns]) for each in (points, normals)]
    return UprightBank([state for state, _ in bodies], turns, turned[0], turned[1], np.array(statures))


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


def _place(state: BodyState, turn: np.ndarray, shift: np.ndarray) -> BodyState:
    return BodyState(state.center @ turn.T + shift, turn @ state.rotation, state.pose.copy(), state.shape.copy())
