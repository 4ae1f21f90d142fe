# SPDX-License-Identifier: Apache-2.0
"""A reference implementation of the body search in plain NumPy and SciPy, for tests and speed ratios.

The same equations in the same order as the modules of `body.search` and `inference.diverse`, one particle and one pair
at a time, without compiled code. With the grid's closest points the results are equal up to rounding; by default it
queries a cKDTree.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from flowing_puppet_ros.body.search.dpmp import BodyParticleSearch
from flowing_puppet_ros.body.search.energy import MIN_CENTRE_DISTANCE_M, JointTargets, ScoredParticles
from flowing_puppet_ros.body.search.levenberg import (
    CONTRADICTING_WEIGHT,
    DAMPING_FACTOR,
    INITIAL_DAMPING,
    MAX_ROTATION_STEP_RAD,
    POSE_PRIOR_WEIGHT,
)
from flowing_puppet_ros.body.search.part_points import PartPoints
from flowing_puppet_ros.body.search.particles import Particles
from flowing_puppet_ros.body.search.schedule import Stage
from flowing_puppet_ros.evidence.cloud.data_term import DISTANCE_OFFSET, DISTANCE_POWER, MISMATCH_COSINE, CloudGrid
from flowing_puppet_ros.inference.max_product import MaxProduct, max_product, message_foundation
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import MAX_DEVIATIONS

# From points (n, 3) to the indices (n,) of the nearest points of the cloud.
Nearest = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, slots=True, eq=False)
class PlainCloud:
    """A cloud `points` (N, 3) m with unit `normals` (N, 3), and a function that finds `nearest` points."""

    points: np.ndarray
    normals: np.ndarray
    nearest: Nearest

    @classmethod
    def of_tree(cls, points: np.ndarray, normals: np.ndarray) -> PlainCloud:
        """Make a cloud whose closest points are found exactly, by a cKDTree."""
        tree = cKDTree(points)
        return cls(points, normals, lambda asked: tree.query(asked)[1])

    @classmethod
    def of_grid(cls, grid: CloudGrid) -> PlainCloud:
        """Make a cloud whose closest points are those of a grid."""

        def nearest(asked: np.ndarray) -> np.ndarray:
            cells = np.floor((asked - grid.origin) / grid.cell + 0.5).astype(np.int64)
            cells = np.clip(cells, 0, np.array(grid.nearest.shape) - 1)
            return grid.nearest[cells[:, 0], cells[:, 1], cells[:, 2]]

        return cls(grid.points, grid.normals, nearest)

    def data_cost(self, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `CloudGrid.data_cost`."""
        cost, mismatch = np.zeros(len(points)), np.zeros(len(points))
        for particle, (own, own_normals) in enumerate(zip(points, normals, strict=True)):
            found = self.nearest(own)
            squared = ((own - self.points[found]) ** 2).sum(axis=1)
            cost[particle] = ((squared + DISTANCE_OFFSET) ** DISTANCE_POWER).mean()
            mismatch[particle] = ((own_normals * self.normals[found]).sum(axis=1) < MISMATCH_COSINE).mean()
        return cost, mismatch


class PlainSearch(BodyParticleSearch):
    """`BodyParticleSearch` with plain moves, stitching costs and selection."""

    def _improve(self, part: int, new: Particles, grid: PlainCloud, targets: JointTargets) -> ScoredParticles:  # type: ignore[override]
        moved = improve(self._points[part], new, grid, targets, self._weights.lm_steps, self._weights.lm_points)
        return ScoredParticles.score(self._points[part], moved, grid, targets)

    def _solve(self, scored: list[ScoredParticles], stage: Stage) -> tuple[MaxProduct, list[np.ndarray]]:
        nodes = [
            beta * (group.distance + self._weights.mismatch * group.mismatch) + group.joint_cost
            for beta, group in zip(stage.data, scored, strict=True)
        ]
        edges = []
        for edge, (parent, child) in enumerate(self._model.tree.edges):
            weight = self._model.interfaces[edge].weight
            cost = stitching_costs(weight, scored[parent], scored[child], edge, self._weights.stitch)
            edges.append(stage.stitch[edge] * cost)
        return max_product(self._model.tree, nodes, edges), edges

    def _select(self, part: int, count: int, result: MaxProduct, edges: list[np.ndarray], greedy: bool) -> np.ndarray:
        if greedy:
            return super()._select(part, count, result, edges, greedy)
        foundation = message_foundation(self._model.tree, edges, result, part)
        return select_diverse(foundation, count, int(result.assignment[part]), self._weights.temperature)


def improve(
    points: PartPoints, particles: Particles, cloud: PlainCloud, targets: JointTargets, steps: int, count: int
) -> Particles:
    """See `levenberg.levenberg_marquardt`."""
    center, rotation, pose = particles.center.copy(), particles.rotation.copy(), particles.pose.copy()
    for p in range(len(particles)):
        problem = _Problem(points, particles.shape[p], cloud, targets, count)
        damping, (cost, hessian, gradient) = INITIAL_DAMPING, problem.normal_equations(center[p], rotation[p], pose[p])
        for _ in range(steps):
            damped = hessian + np.diag(damping * np.diag(hessian) + 1e-9)
            step = np.linalg.solve(damped, -gradient)
            step *= min(1.0, MAX_ROTATION_STEP_RAD / max(float(np.linalg.norm(step[:3])), 1e-12))
            trial = (
                center[p] + rotation[p] @ step[3:6],
                rotation[p] @ so3.exp(step[:3]),
                np.clip(pose[p] + step[6:], -MAX_DEVIATIONS, MAX_DEVIATIONS),
            )
            new_cost, new_hessian, new_gradient = problem.normal_equations(*trial)
            if new_cost < cost:
                (center[p], rotation[p], pose[p]), damping = trial, damping / DAMPING_FACTOR
                cost, hessian, gradient = new_cost, new_hessian, new_gradient
            else:
                damping *= DAMPING_FACTOR
    return Particles(center, rotation, pose, particles.shape)


class _Problem:
    """The least-squares problem of one particle: its points, in the part's frame, against the closest cloud points."""

    def __init__(
        self, points: PartPoints, shape: np.ndarray, cloud: PlainCloud, targets: JointTargets, count: int
    ) -> None:
        surface, joints = points.surface, points.joints
        self._count = min(count, len(surface))
        self._mean = np.concatenate(
            [surface.apply_shape(shape[None])[0, : self._count], joints.apply_shape(shape[None])[0]]
        )
        self._basis = np.concatenate([surface.pose_basis[: self._count], joints.pose_basis])
        self._normals = points.normals[: self._count]
        believed = targets.weight[points.joint_index]
        self._weight = np.concatenate([np.full(self._count, 1.0 / self._count), believed])
        self._target = targets.points[points.joint_index]
        self._cloud = cloud

    def normal_equations(
        self, center: np.ndarray, rotation: np.ndarray, pose: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Return half the weighted sum of squares, J^T W J and J^T W r (Eqs. 57-64)."""
        local = self._mean + self._basis @ pose
        world = local @ rotation.T + center
        found = self._cloud.nearest(world[: self._count])
        goal = np.concatenate([self._cloud.points[found], self._target])
        contradicts = (self._cloud.normals[found] * (self._normals @ rotation.T)).sum(axis=1) < 0
        weight = self._weight.copy()
        weight[: self._count][contradicts] *= CONTRADICTING_WEIGHT
        residual = (world - goal) @ rotation
        jacobian = np.zeros((len(local), 3, 6 + len(pose)))
        for axis, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
            jacobian[:, i, axis] = -local[:, j]
            jacobian[:, j, axis] = local[:, i]
        jacobian[:, :, 3:6] = np.eye(3)
        jacobian[:, :, 6:] = self._basis
        rows, weights = jacobian.reshape(3 * len(local), -1), np.repeat(weight, 3)
        hessian = (rows * weights[:, None]).T @ rows
        gradient = rows.T @ (weights * residual.ravel())
        hessian[6:, 6:] += POSE_PRIOR_WEIGHT * np.eye(len(pose))
        gradient[6:] += POSE_PRIOR_WEIGHT * pose
        cost = 0.5 * float((weight * (residual**2).sum(axis=1)).sum() + POSE_PRIOR_WEIGHT * (pose**2).sum())
        return cost, hessian, gradient


def stitching_costs(
    weight: np.ndarray, parent: ScoredParticles, child: ScoredParticles, edge: int, strength: float
) -> np.ndarray:
    """See `energy.stitching_costs`; computes every pair of particles separately."""
    share = weight / weight.sum()
    costs = np.empty((len(parent.particles), len(child.particles)))
    for i, own in enumerate(parent.interfaces[edge]):
        for j, other in enumerate(child.interfaces[edge]):
            apart = np.linalg.norm(parent.particles.center[i] - child.particles.center[j])
            costs[i, j] = strength * (share * ((own - other) ** 2).sum(axis=1)).sum() + (apart < MIN_CENTRE_DISTANCE_M)
    return costs


def select_diverse(foundation: np.ndarray, count: int, kept: int, temperature: float) -> np.ndarray:
    """See `diverse.select_diverse`; recomputes the gain of every candidate in each round."""
    weights = np.exp((foundation.min(axis=1, keepdims=True) - foundation) / temperature)
    chosen, covered = [kept], weights[:, kept]
    while len(chosen) < count:
        gains = np.maximum(weights - covered[:, None], 0.0).sum(axis=0)
        gains[chosen] = -np.inf
        chosen.append(int(gains.argmax()))
        covered = np.maximum(covered, weights[:, chosen[-1]])
    return np.array(chosen)
