# SPDX-License-Identifier: Apache-2.0
"""Bodies of one model at all yaws on a floor, and how well each explains a candidate.

They are on the floor as they are, so only the place and the yaw are free.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.cloud.mesh_geometry import farthest_points, vertex_normals
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.evidence.cloud.one_sided import distances
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

YAWS = 16
MEAN_STATURE_M, STATURE_DEVIATION_M, STATURE_COST_M = 1.72, 0.1, 0.002
"""Statures of people, and the mean distance that one squared deviation from them is worth."""
MAX_DEVIATIONS = 3.0  # of a stature, beyond which it costs no more
ROUGH_POINTS, FINE_POINTS = 90, 300  # surface points of a body
ROUGH_TARGETS, FINE_TARGETS = 60, 250  # of the cloud
FINE_BODIES, MAX_SAME_YAW = 96, 2
TURNED = 3  # of the best bodies, that face the other way than the best
TOP_M = 0.35  # below the top of a cloud, of what a body is placed by
TOP_COST, OVER_TOP_M, BELOW_TOP_M, MAX_TOP_COST_M = 0.2, 0.12, 0.05, 0.06
"""Cost of a metre by which such a body is higher or lower than the cloud, beyond what the gap between two rings hides,
and the most that counts."""
SEEN_MARGIN_M = 0.08  # above and below a cloud within which a body's surface is taken for seen


@dataclass(frozen=True, slots=True, eq=False)
class BodyBank:
    """Bodies of one model that stand or sit on a floor; row = yaw * P + pose.

    Attributes:
        states: P bodies that face along x, hips at x = y = 0, the floor at z = 0.
        turns: (YAWS, 3, 3).
        points: (YAWS * P, FINE_POINTS, 3) m, so ordered that the first are spread evenly.
        normals: (YAWS * P, FINE_POINTS, 3).
        stature: (P,) metres.
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
        by_top: bool = False,
    ) -> list[tuple[float, BodyState]]:
        """Return the best bodies on a cloud with their costs in metres, at most two of a yaw and `count` of all.

        A few of them face the other way than the best: few points hardly tell front from back, and only the refined
        bodies show which it is. `floor` is z of the floor, metres. Where it is known to which side, `facing` (2,), all
        face there. Of the poses and of the yaws, one out of `every` so many is compared. Bodies are placed by all that
        is seen of them, or `by_top`, by what is highest, which is theirs where they sit on something.
        """
        poses = len(self.states)
        rows = np.arange(len(self.points)).reshape(YAWS, poses)[::every, ::every].ravel()
        if facing is not None:
            rows = rows[(self.turns[:, :2, 0] @ facing > 0)[rows // poses]]
        targets = cloud.points[farthest_points(cloud.points, FINE_TARGETS)]
        rough, _ = self._judge(cloud, floor, rows, targets[:ROUGH_TARGETS], ROUGH_POINTS, by_top)
        rows = rows[np.argsort(rough, kind="stable")[:FINE_BODIES]]
        cost, shift = self._judge(cloud, floor, rows, targets, FINE_POINTS, by_top)
        order = np.argsort(cost, kind="stable")
        yaw = rows // poses
        apart = np.abs((yaw - yaw[order[0]] + YAWS // 2) % YAWS - YAWS // 2) * (2 * np.pi / YAWS)
        first = _take_of_each_yaw(order, yaw, count - TURNED)
        turned = [k for k in first if apart[k] > np.pi / 2]
        others = [k for k in order if apart[k] > np.pi / 2 and k not in first]
        chosen = [*first, *_take_of_each_yaw(np.array(others, dtype=np.int64), yaw, max(TURNED - len(turned), 0))]
        return [
            (float(cost[k]), _place(self.states[rows[k] % poses], self.turns[yaw[k]], shift[k]))
            for k in sorted(chosen, key=lambda k: float(cost[k]))
        ]

    def _judge(
        self,
        cloud: SingleViewCloud,
        floor: float,
        rows: np.ndarray,
        targets: np.ndarray,
        surface: int,
        by_top: bool,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the costs (P,) m of bodies moved to the cloud, and by how much (P, 3) m they were moved."""
        points, normals = self.points[rows, :surface], self.normals[rows, :surface]
        middle = targets.mean(axis=0)
        low, high = targets[:, 2].min() - floor - SEEN_MARGIN_M, targets[:, 2].max() - floor + SEEN_MARGIN_M
        seen = (normals @ (middle - cloud.view.viewpoint) < 0) & (points[:, :, 2] > low) & (points[:, :, 2] < high)
        placed, at, top = seen, middle, float(cloud.points[:, 2].max())
        if by_top:
            placed = seen & (points[:, :, 2] > top - floor - TOP_M)
            at = cloud.points[cloud.points[:, 2] > top - TOP_M].mean(axis=0)
        sums = (points[:, :, :2] * placed[:, :, None]).sum(axis=1)
        shift = np.full((len(rows), 3), floor)
        shift[:, :2] = at[:2] - sums / np.maximum(placed.sum(axis=1), 1)[:, None]
        moved = points + shift[:, None, :]
        misfit, facing = cloud.view.misfit(moved, normals)
        cost = distances(targets, moved, facing).mean(axis=1) + misfit
        if by_top:
            over = self.points[rows, :, 2].max(axis=1) - (top - floor)
            beyond = np.maximum(over - OVER_TOP_M, 0) + np.maximum(-over - BELOW_TOP_M, 0)
            cost += np.minimum(TOP_COST * beyond, MAX_TOP_COST_M)
        return cost + stature_cost(self.stature)[rows % len(self.states)], shift


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


def turn_bodies(model: StitchedPuppet, bodies: list[tuple[BodyState, np.ndarray]]) -> BodyBank:
    """Make a bank of bodies that face along x and their vertices (V, 3) m."""
    rows = farthest_points(model.vertices(model.rest_state()), FINE_POINTS)
    points, normals, statures = [], [], []
    for state, vertices in bodies:
        points.append(vertices[rows])
        normals.append(vertex_normals(vertices, model.faces)[rows])
        statures.append(model.measure_height(state.shape))
    turns = so3.exp(np.array([0.0, 0.0, 2 * np.pi / YAWS]) * np.arange(YAWS)[:, None])
    turned = [np.concatenate([np.stack(each) @ turn.T for turn in turns]) for each in (points, normals)]
    return BodyBank([state for state, _ in bodies], turns, turned[0], turned[1], np.array(statures))


def _place(state: BodyState, turn: np.ndarray, shift: np.ndarray) -> BodyState:
    return BodyState(state.center @ turn.T + shift, turn @ state.rotation, state.pose.copy(), state.shape.copy())
