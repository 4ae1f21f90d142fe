# SPDX-License-Identifier: Apache-2.0
"""A bank of bodies in many poses and yaws, and a coarse and fast cost of whole bodies on a cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from flowing_puppet_ros.body.cloud.correspondence import Cloud
from flowing_puppet_ros.body.cloud.mesh_geometry import farthest_points
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.search.part_points import PartPoints, PointSet
from flowing_puppet_ros.body.search.particles import Particles, particles_to_state, states_to_particles
from flowing_puppet_ros.evidence.cloud.one_sided import distances, mean_distance
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

POSES, YAWS = 200, 16
"""The bank has every pose in every yaw."""
TARGETS = 250
"""Points of the cloud that the body must cover."""
ROUGH_SHARE, ROUGH_TARGETS, FINE_POSES = 0.33, 80, 12
"""Share of the surface points and number of the targets by which all bodies are judged, and the best poses of each yaw
that are judged by all."""
COARSE_POSES, COARSE_TARGETS = 40, 100
"""Poses and targets by which frames are compared."""
SURFACE_POINTS = {
    "torso": 56, "head": 20, "shoulder": 14, "upper_arm": 18, "lower_arm": 16, "hand": 10,
    "upper_leg": 26, "lower_leg": 22, "foot": 12,
}  # fmt: skip
"""Surface points of each part, about one to 50 square centimetres."""
JOINT_PRIOR_M = 1e-4
"""Mean distance that a squared Mahalanobis distance of 1 of a joint's rotation is worth."""
JOINT_RIDGE_RAD = 0.05
"""Standard deviation added to a joint's rotation."""
END_TARGETS, BEYOND_END_M, MIN_UNKNOWN_END = 10, 0.15, 0.5
"""A cloud is cut off at its top or bottom if this share of places so far beyond so many of its outermost points is
unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class CoarseCloud:
    """A cloud with the few of its points that must be covered.

    Attributes:
        cloud: a whole cloud, or a `SingleViewCloud`.
        targets: (M, 3) metres, spread evenly.
    """

    cloud: Cloud
    targets: np.ndarray

    @classmethod
    def of(cls, cloud: Cloud, targets: int = TARGETS) -> CoarseCloud:
        """Choose `targets` points that must be covered."""
        return cls(cloud, cloud.points[farthest_points(cloud.points, targets)])


@dataclass(frozen=True, slots=True, eq=False)
class CoverageCost:
    """The costs of P whole bodies on a cloud.

    Attributes:
        cost: (P,) metres.
        distance: (P, M) metres, from the targets to the body.
    """

    cost: np.ndarray
    distance: np.ndarray


class PoseBank:
    """The bank of one model."""

    def __init__(self, model: StitchedPuppet, points: tuple[PartPoints, ...]) -> None:
        self._model = model
        sizes = [SURFACE_POINTS[name.removeprefix("left_").removeprefix("right_")] for name in model.tree.names]
        self._share = np.array(sizes) / sum(sizes)
        starts = np.cumsum([0, *sizes[:-1]])
        self._rough_columns = np.concatenate(
            [start + np.arange(round(ROUGH_SHARE * size)) for start, size in zip(starts, sizes, strict=True)]
        )
        self._surface = [_take_first(part.surface, size) for part, size in zip(points, sizes, strict=True)]
        self._normals = [part.normals[:size] for part, size in zip(points, sizes, strict=True)]
        precisions = [
            np.linalg.inv(pair.covariance[:3, :3] + JOINT_RIDGE_RAD**2 * np.eye(3)) for pair in model.pairwise
        ]
        self._joints = [(pair.mean[:3], precision) for pair, precision in zip(model.pairwise, precisions, strict=True)]

    def find_best(self, coarse: CoarseCloud, count: int) -> list[BodyState]:
        """Return the best body of each of the `count` best yaws, moved to the cloud.

        All are judged by few points first, and the best of each yaw by all points.
        """
        rough = replace(coarse, targets=coarse.targets[:ROUGH_TARGETS])
        costs, _ = self._judge_bank(rough, POSES, self._rough_columns)
        poses = np.argsort(costs, axis=1, kind="stable")[:, :FINE_POSES]
        rows = (np.arange(YAWS)[:, None] * POSES + poses).reshape(-1)
        bodies = self._move_to_cloud(_take_bodies(self._model, rows), coarse)
        cost = self.coverage_cost(bodies, coarse, range(len(bodies))).cost.reshape(YAWS, FINE_POSES)
        yaws = np.argsort(cost.min(axis=1), kind="stable")[:count]
        best = [yaw * FINE_POSES + int(cost[yaw].argmin()) for yaw in yaws]
        return [particles_to_state(self._model, bodies, np.full(len(bodies), row)) for row in best]

    def find_roughly(self, cloud: Cloud, count: int) -> list[BodyState]:
        """Return the best body of each of the `count` best yaws of a small bank, moved to the cloud."""
        costs, shift = self._judge_bank(CoarseCloud.of(cloud, COARSE_TARGETS), COARSE_POSES)
        states = []
        for yaw in np.argsort(costs.min(axis=1), kind="stable")[:count]:
            pose = int(costs[yaw].argmin())
            groups = _take_bodies(self._model, np.array([yaw * POSES + pose]))
            body = particles_to_state(self._model, groups, np.zeros(len(groups), dtype=np.int64))
            states.append(replace(body, center=body.center + shift[yaw, pose]))
        return states

    def coarse_cost(self, cloud: Cloud) -> float:
        """Return the cost in metres of the best upright body of a small bank on a cloud.

        It tells a cloud with the head up from the same cloud upside down.
        """
        return float(self._judge_bank(CoarseCloud.of(cloud, COARSE_TARGETS), COARSE_POSES)[0].min())

    def _judge_bank(
        self, coarse: CoarseCloud, poses: int, columns: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Judge the first `poses` of the bank in every yaw, by all of their points or by some `columns` of them.

        Returns:
            Costs (YAWS, poses) m, and the steps (YAWS, poses, 3) m that move the bodies to the cloud.
        """
        points, normals, prior = self._bank_surface
        every = np.arange(points.shape[1]) if columns is None else columns
        points, normals, prior = points[:poses, every], normals[:poses, every], prior[:poses]
        costs, shifts = np.empty((YAWS, poses)), np.empty((YAWS, poses, 3))
        for yaw, turn in enumerate(_list_yaws()):
            turned, facing = points @ turn.T, normals @ turn.T
            shifts[yaw] = self._shift_to_cloud(turned, facing, coarse)
            turned += shifts[yaw][:, None]
            misfit, able = _measure_misfit(turned, facing, coarse)
            costs[yaw] = distances(coarse.targets, turned, able).mean(axis=1) + misfit + prior
        return costs, shifts

    @cached_property
    def _bank_surface(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Surface points and normals (POSES, K, 3) and joint priors (POSES,) of the bank's bodies in the first yaw."""
        bodies = make_bank(self._model)
        return *self._pose_surface(bodies, range(len(bodies))), self._joint_prior(bodies, range(len(bodies)))

    def cost(self, body: BodyState, coarse: CoarseCloud) -> float:
        """Return the cost of one body on a cloud, metres."""
        groups = states_to_particles(self._model, [body])
        return float(self.coverage_cost(groups, coarse, range(len(groups))).cost[0])

    def coverage_cost(
        self,
        bodies: list[Particles],
        coarse: CoarseCloud,
        parts: Sequence[int],
        other_distance: np.ndarray | float = np.inf,
    ) -> CoverageCost:
        """Compute the costs of bodies (row p of every part is body p) by some of their parts.

        The cost is the mean distance of the cloud to the body, plus the mean distance by which the body contradicts
        the cloud, plus the joint prior. `other_distance` (1, M) is that of the targets to the other parts, metres.
        """
        points, normals = self._pose_surface(bodies, parts)
        misfit, able = _measure_misfit(points, normals, coarse)
        distance = np.minimum(distances(coarse.targets, points, able), other_distance)
        cost = distance.mean(axis=1) + self._share[list(parts)].sum() * misfit + self._joint_prior(bodies, parts)
        return CoverageCost(cost, distance)

    def _joint_prior(self, bodies: list[Particles], parts: Sequence[int]) -> np.ndarray:
        """Return what the rotations at the joints of some parts cost each body (P,), metres."""
        cost = np.zeros(1)
        for part in parts:
            if part:
                mean, precision = self._joints[part - 1]
                above = bodies[self._model.tree.parents[part]].rotation.transpose(0, 2, 1)
                gap = so3.log(above @ bodies[part].rotation) - mean
                cost = cost + JOINT_PRIOR_M * ((gap @ precision) * gap).sum(axis=1)
        return cost

    def _move_to_cloud(self, bodies: list[Particles], coarse: CoarseCloud) -> list[Particles]:
        """Move each body so that the mean of its surface, or of the surface that faces the sensor, is the cloud's."""
        shift = self._shift_to_cloud(*self._pose_surface(bodies, range(len(bodies))), coarse)
        return [Particles(group.center + shift, group.rotation, group.pose, group.shape) for group in bodies]

    @staticmethod
    def _shift_to_cloud(points: np.ndarray, normals: np.ndarray, coarse: CoarseCloud) -> np.ndarray:
        """Return the steps (P, 3) that move bodies with surface points and normals (P, K, 3) to the cloud."""
        middle = coarse.targets.mean(axis=0)
        seen = np.ones((*points.shape[:2], 1), dtype=bool)
        if isinstance(coarse.cloud, SingleViewCloud):
            away = middle - coarse.cloud.view.viewpoints
            seen = (normals @ away.T < 0).any(axis=2, keepdims=True)
            seen &= _find_same_height(points[:, :, 2], coarse)[:, :, None]
        return np.asarray(middle - (points * seen).sum(axis=1) / np.maximum(seen.sum(axis=1), 1))

    def _pose_surface(self, bodies: list[Particles], parts: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return the surface points (P, K, 3) of some parts in metres, and their normals (P, K, 3)."""
        points = [self._surface[part].to_world(bodies[part]) for part in parts]
        normals = [self._normals[part] @ bodies[part].rotation.transpose(0, 2, 1) for part in parts]
        return np.concatenate(points, axis=1), np.concatenate(normals, axis=1)


@lru_cache(maxsize=3)
def make_bank(model: StitchedPuppet) -> list[Particles]:
    """Sample the bank: the particles of each part in every pose, in the first yaw; made once for a model."""
    rng = np.random.default_rng(0)
    bodies = model.sample_many(rng, POSES, shape_scale=0.0)
    return [
        Particles(
            bodies.center[:, part],
            bodies.rotation[:, part],
            bodies.pose[:, part, : model.pose_count(part)],
            bodies.shape[:, part],
        )
        for part in range(len(model.tree))
    ]


def _take_bodies(model: StitchedPuppet, rows: np.ndarray) -> list[Particles]:
    """Return the particles of bodies of the bank; row = yaw * POSES + pose."""
    turns = _list_yaws()[rows // POSES]
    taken = [group.take(rows % POSES) for group in make_bank(model)]
    return [
        Particles((turns @ group.center[:, :, None])[:, :, 0], turns @ group.rotation, group.pose, group.shape)
        for group in taken
    ]


def _list_yaws() -> np.ndarray:
    """Return the rotations (YAWS, 3, 3) about the upright axis."""
    return so3.exp(np.array([0.0, 0.0, 2 * np.pi / YAWS]) * np.arange(YAWS)[:, None])


def _measure_misfit(points: np.ndarray, normals: np.ndarray, coarse: CoarseCloud) -> tuple[np.ndarray, np.ndarray]:
    """Return how far surface points (P, K, 3) contradict the cloud (P,), metres, and which (P, K) may cover it."""
    if isinstance(coarse.cloud, SingleViewCloud):
        return coarse.cloud.view.misfit(points, normals)
    return mean_distance(points, coarse.targets), np.ones(points.shape[:2], dtype=np.bool_)


def _find_same_height(height: np.ndarray, coarse: CoarseCloud) -> np.ndarray:
    """Return which surface points (P, K) of bodies, at `height` (P, K) m, may be as high as the cloud is on the person.

    Where the sensor could not see above or below the cloud, the person goes on there: only as much of a body counts as
    the cloud is high, from its other end.
    """
    every = np.ones(height.shape, dtype=bool)
    field, targets = coarse.cloud.field, coarse.targets
    if field is None:
        return every
    order = np.argsort(targets[:, 2])
    step = np.array([0.0, 0.0, BEYOND_END_M])
    below = field.find_unknown(targets[order[:END_TARGETS]] - step).mean() > MIN_UNKNOWN_END
    above = field.find_unknown(targets[order[-END_TARGETS:]] + step).mean() > MIN_UNKNOWN_END
    extent = float(np.ptp(targets[:, 2]))
    if below and not above:
        return np.asarray(height > height.max(axis=1, keepdims=True) - extent)
    if above and not below:
        return np.asarray(height < height.min(axis=1, keepdims=True) + extent)
    return every


def _take_first(points: PointSet, count: int) -> PointSet:
    return PointSet(points.mean[:count], points.pose_basis[:count], points.shape_basis[:count])
