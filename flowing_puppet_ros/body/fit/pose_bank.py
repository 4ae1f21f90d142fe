# SPDX-License-Identifier: Apache-2.0
"""A bank of bodies in many poses and yaws, and how well whole bodies explain a cloud, coarsely and fast."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from flowing_puppet_ros.body.cloud.correspondence import Cloud
from flowing_puppet_ros.body.cloud.mesh_geometry import farthest_points
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.search.part_points import PartPoints, PointSet
from flowing_puppet_ros.body.search.particles import Particles, particles_to_state, states_to_particles
from flowing_puppet_ros.evidence.cloud.one_sided import distances, mean_distance
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

BANK, YAWS = 200, 16
COARSE_BANK, COARSE_TARGETS = 40, 100
"""Bodies and points of the cloud by which frames are compared."""
TARGETS = 250
"""Points of the cloud that must be covered."""
SURFACE = {
    "torso": 56, "head": 20, "shoulder": 14, "upper_arm": 18, "lower_arm": 16, "hand": 10,
    "upper_leg": 26, "lower_leg": 22, "foot": 12,
}  # fmt: skip
"""Surface points a part, about one to 50 square centimetres."""
PRIOR = 1e-4
"""Metres of mean distance that a squared Mahalanobis distance of 1 of a joint's rotation is worth."""
JOINT_RIDGE = 0.05
"""Radians added to the spread of a joint's rotation."""


@dataclass(frozen=True, slots=True, eq=False)
class CoarseCloud:
    """A cloud with the few of its points that must be covered.

    Attributes:
        cloud: from all sides, or a ViewCloud.
        targets: (M, 3) metres, spread evenly.
    """

    cloud: Cloud
    targets: np.ndarray

    @classmethod
    def of(cls, cloud: Cloud, targets: int = TARGETS) -> CoarseCloud:
        """Choose the targets."""
        return cls(cloud, cloud.points[farthest_points(cloud.points, targets)])


@dataclass(frozen=True, slots=True, eq=False)
class CoverageCost:
    """Whole bodies against a cloud.

    Attributes:
        cost: (P,) metres.
        distance: (P, M) metres from the targets to the body.
    """

    cost: np.ndarray
    distance: np.ndarray


class PoseBank:
    """Bodies of one model."""

    def __init__(self, model: StitchedPuppet, points: tuple[PartPoints, ...]) -> None:
        self._model = model
        sizes = [SURFACE[name.removeprefix("left_").removeprefix("right_")] for name in model.tree.names]
        self._share = np.array(sizes) / sum(sizes)
        self._surface = [_first(part.surface, size) for part, size in zip(points, sizes, strict=True)]
        self._normals = [part.normals[:size] for part, size in zip(points, sizes, strict=True)]
        spread = [np.linalg.inv(pair.covariance[:3, :3] + JOINT_RIDGE**2 * np.eye(3)) for pair in model.pairwise]
        self._joints = [(pair.mean[:3], precision) for pair, precision in zip(model.pairwise, spread, strict=True)]

    def best(self, coarse: CoarseCloud, count: int) -> list[BodyState]:
        """The bank's bodies that explain a cloud best, each the best of its yaw and moved to the cloud."""
        bodies = self._placed(bank_bodies(self._model), coarse)
        cost = self.coverage_cost(bodies, coarse, range(len(bodies))).cost.reshape(YAWS, BANK)
        yaws = np.argsort(cost.min(axis=1), kind="stable")[:count]
        rows = [yaw * BANK + int(cost[yaw].argmin()) for yaw in yaws]
        return [particles_to_state(self._model, bodies, np.full(len(bodies), row)) for row in rows]

    def coarse_cost(self, cloud: Cloud) -> float:
        """How well, in metres, any upright body of a small bank explains a cloud; lower is better.

        Tells a cloud whose z axis is the body's long axis from the same cloud turned over.
        """
        coarse = CoarseCloud.of(cloud, COARSE_TARGETS)
        rows = np.flatnonzero(np.arange(YAWS * BANK) % BANK < COARSE_BANK)
        bodies = self._placed([group.take(rows) for group in bank_bodies(self._model)], coarse)
        return float(self.coverage_cost(bodies, coarse, range(len(bodies))).cost.min())

    def cost(self, body: BodyState, coarse: CoarseCloud) -> float:
        """How badly, in metres, one body explains a cloud."""
        groups = states_to_particles(self._model, [body])
        return float(self.coverage_cost(groups, coarse, range(len(groups))).cost[0])

    def coverage_cost(
        self, bodies: list[Particles], coarse: CoarseCloud, parts: Sequence[int], already: np.ndarray | float = np.inf
    ) -> CoverageCost:
        """Judge bodies (row p of every part is body p) by some of their parts.

        The cost is the mean distance of the cloud to the body, the mean distance by which the body contradicts the
        cloud, and what unusual joints cost. `already` (1, M) is how far the targets are from the other parts.
        """
        points, normals = self._points(bodies, parts)
        if isinstance(coarse.cloud, SingleViewCloud):
            misfit, able = coarse.cloud.view.misfit(points, normals)
        else:
            misfit, able = mean_distance(points, coarse.targets), np.ones(points.shape[:2], dtype=np.bool_)
        distance = np.minimum(distances(coarse.targets, points, able), already)
        cost = distance.mean(axis=1) + self._share[list(parts)].sum() * misfit
        for part in parts:
            if part:
                mean, precision = self._joints[part - 1]
                above = bodies[self._model.tree.parents[part]].rotation.transpose(0, 2, 1)
                gap = so3.log(above @ bodies[part].rotation) - mean
                cost = cost + PRIOR * ((gap @ precision) * gap).sum(axis=1)
        return CoverageCost(cost, distance)

    def _placed(self, bodies: list[Particles], coarse: CoarseCloud) -> list[Particles]:
        """Move each body so that the mean of its surface, or of what of it faces the sensor, is the cloud's."""
        points, normals = self._points(bodies, range(len(bodies)))
        middle = coarse.targets.mean(axis=0)
        seen = np.ones((*points.shape[:2], 1), dtype=bool)
        if isinstance(coarse.cloud, SingleViewCloud):
            seen = (normals @ (middle - coarse.cloud.view.viewpoint) < 0)[:, :, None]
        shift = middle - (points * seen).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
        return [Particles(group.center + shift, group.rotation, group.pose, group.shape) for group in bodies]

    def _points(self, bodies: list[Particles], parts: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Surface points (P, K, 3) and their normals of some parts."""
        points = [self._surface[part].world(bodies[part]) for part in parts]
        normals = [self._normals[part] @ bodies[part].rotation.transpose(0, 2, 1) for part in parts]
        return np.concatenate(points, axis=1), np.concatenate(normals, axis=1)


@lru_cache(maxsize=3)
def bank_bodies(model: StitchedPuppet) -> list[Particles]:
    """Per part the bank's bodies in every yaw; made once for a model."""
    rng = np.random.default_rng(0)
    bank = states_to_particles(model, [model.sample(rng, shape_scale=0.0) for _ in range(BANK)])
    turns = so3.exp(np.array([0.0, 0.0, 2 * np.pi / YAWS]) * np.arange(YAWS)[:, None])
    return [Particles.join([_turned(group, turn) for turn in turns]) for group in bank]


def _first(points: PointSet, count: int) -> PointSet:
    return PointSet(points.mean[:count], points.pose_basis[:count], points.shape_basis[:count])


def _turned(group: Particles, turn: np.ndarray) -> Particles:
    return Particles(group.center @ turn.T, turn @ group.rotation, group.pose, group.shape)
