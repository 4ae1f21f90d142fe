# SPDX-License-Identifier: Apache-2.0
"""Levenberg-Marquardt moves: every new particle is drawn to its closest cloud points (thesis Eqs. 55-64).

The unknowns are rotation, translation and pose deformation. Residuals are taken in the part's own frame, which leaves
the sum of squares as it is: with y = R^T (v - o) for cloud point v and p for the model point in that frame the
residual is p - y, its derivative with respect to a rotation increment on the right of R is -[p]x, with respect to the
translation (in the part's frame) the identity, and with respect to the deformation the constant basis.

Other than the thesis, which damps with lambda I and takes every residual alike: the damping is scaled by the diagonal
of J J^T (Marquardt 1963), so that radians, metres and coefficients are damped alike; points whose normals contradict
the cloud's count less, believed joints pull too, and a weak prior keeps the deformation bounded.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from flowing_puppet_ros.body.energy import JointTargets
from flowing_puppet_ros.body.particles import Particles
from flowing_puppet_ros.body.points import PartPoints
from flowing_puppet_ros.evidence.cloud import CloudGrid, look_up
from flowing_puppet_ros.model.sp import DEVIATIONS

DAMPING = 0.1
DAMPING_FACTOR = 10.0
MAX_TURN = 0.6
POSE_PRIOR = 5e-5
CONTRADICTING_WEIGHT = 0.3
# Points, normals, nearest indices, origin and cell of a CloudGrid.
CloudArrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]


def improve(
    points: PartPoints, particles: Particles, grid: CloudGrid, targets: JointTargets, steps: int, count: int
) -> Particles:
    """Run `steps` LM steps on every particle of one part, with the closest points renewed at each step.

    Args:
        points: the part's points.
        particles: where to start.
        grid: the cloud; a closest point whose normal contradicts the model's counts less.
        targets: believed joints, which pull with their weights.
        steps: tried steps a particle.
        count: how many surface points to use.

    Returns:
        Particles of the same shape coefficients whose sum of squares is not larger.
    """
    surface, joints = points.surface, points.joints
    count = min(count, len(surface))
    center, rotation = particles.center.copy(), np.ascontiguousarray(particles.rotation)
    pose = particles.pose.copy()
    mean = np.concatenate([surface.shaped(particles.shape)[:, :count], joints.shaped(particles.shape)], axis=1)
    basis = np.concatenate([surface.pose_basis[:count], joints.pose_basis])
    weight = np.concatenate([np.full(count, 1.0 / count), targets.weight[points.joint_index]])
    target = np.ascontiguousarray(targets.points[points.joint_index])
    normals = np.ascontiguousarray(points.normals[:count])
    cloud = (grid.points, grid.normals, grid.nearest, grid.origin, grid.cell)
    _improve_all(center, rotation, pose, mean, np.ascontiguousarray(basis), normals, weight, target, cloud, steps)
    return Particles(center, rotation, pose, particles.shape)


@njit(cache=True)
def _improve_all(
    center: np.ndarray,
    rotation: np.ndarray,
    pose: np.ndarray,
    mean: np.ndarray,
    basis: np.ndarray,
    normals: np.ndarray,
    weight: np.ndarray,
    target: np.ndarray,
    cloud: CloudArrays,
    steps: int,
) -> None:
    unknowns = 6 + pose.shape[1]
    for p in range(len(center)):
        damping = DAMPING
        hessian, gradient = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
        cost = _assemble(
            center[p], rotation[p], pose[p], mean[p], basis, normals, weight, target, cloud, hessian, gradient
        )
        for _ in range(steps):
            system = hessian.copy()
            for k in range(unknowns):
                system[k, k] += damping * hessian[k, k] + 1e-9
            step = np.linalg.solve(system, -gradient)
            turn = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
            if turn > MAX_TURN:
                step *= MAX_TURN / turn
            new_center = center[p] + rotation[p] @ step[3:6]
            new_rotation = rotation[p] @ _rotation(step[:3])
            new_pose = np.minimum(np.maximum(pose[p] + step[6:], -DEVIATIONS), DEVIATIONS)
            new_hessian, new_gradient = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
            new_cost = _assemble(
                new_center, new_rotation, new_pose, mean[p], basis, normals, weight, target, cloud,
                new_hessian, new_gradient,
            )  # fmt: skip
            if new_cost < cost:
                center[p], rotation[p], pose[p], cost = new_center, new_rotation, new_pose, new_cost
                hessian, gradient = new_hessian, new_gradient
                damping /= DAMPING_FACTOR
            else:
                damping *= DAMPING_FACTOR


@njit(cache=True)
def _assemble(
    center: np.ndarray,
    rotation: np.ndarray,
    pose: np.ndarray,
    mean: np.ndarray,
    basis: np.ndarray,
    normals: np.ndarray,
    weight: np.ndarray,
    target: np.ndarray,
    cloud: CloudArrays,
    hessian: np.ndarray,
    gradient: np.ndarray,
) -> float:
    """Fill the normal equations and return half the weighted sum of squares."""
    points, point_normals, nearest, origin, cell = cloud
    count, surface, deformations = len(mean), len(normals), len(pose)
    jacobian = np.zeros((3, 6 + deformations))
    jacobian[0, 3] = jacobian[1, 4] = jacobian[2, 5] = 1.0
    world, goal, residual = np.empty(3), np.empty(3), np.empty(3)
    cost = 0.0
    for k in range(count):
        local = mean[k].copy()
        for d in range(deformations):
            for axis in range(3):
                local[axis] += basis[k, axis, d] * pose[d]
                jacobian[axis, 6 + d] = basis[k, axis, d]
        for axis in range(3):
            world[axis] = center[axis]
            for other in range(3):
                world[axis] += rotation[axis, other] * local[other]
        importance = weight[k]
        if k < surface:
            found = look_up(nearest, origin, cell, world[0], world[1], world[2])
            goal[:] = points[found]
            cosine = 0.0
            for axis in range(3):
                for other in range(3):
                    cosine += point_normals[found, axis] * rotation[axis, other] * normals[k, other]
            if cosine < 0.0:
                importance *= CONTRADICTING_WEIGHT
        else:
            goal[:] = target[k - surface]
        for axis in range(3):
            residual[axis] = 0.0
            for other in range(3):
                residual[axis] += rotation[other, axis] * (world[other] - goal[other])
        jacobian[0, 1], jacobian[0, 2] = local[2], -local[1]
        jacobian[1, 0], jacobian[1, 2] = -local[2], local[0]
        jacobian[2, 0], jacobian[2, 1] = local[1], -local[0]
        cost += _accumulate(jacobian, residual, importance, hessian, gradient)
    for d in range(deformations):
        cost += 0.5 * POSE_PRIOR * pose[d] ** 2
        hessian[6 + d, 6 + d] += POSE_PRIOR
        gradient[6 + d] += POSE_PRIOR * pose[d]
    for row in range(6 + deformations):
        for column in range(row):
            hessian[row, column] = hessian[column, row]
    return cost


@njit(cache=True)
def _accumulate(
    jacobian: np.ndarray, residual: np.ndarray, weight: float, hessian: np.ndarray, gradient: np.ndarray
) -> float:
    unknowns = jacobian.shape[1]
    for row in range(unknowns):
        slope = weight * jacobian[0, row], weight * jacobian[1, row], weight * jacobian[2, row]
        gradient[row] += slope[0] * residual[0] + slope[1] * residual[1] + slope[2] * residual[2]
        for column in range(row, unknowns):
            hessian[row, column] += (
                slope[0] * jacobian[0, column] + slope[1] * jacobian[1, column] + slope[2] * jacobian[2, column]
            )
    return 0.5 * weight * (residual[0] ** 2 + residual[1] ** 2 + residual[2] ** 2)


@njit(cache=True)
def _rotation(vector: np.ndarray) -> np.ndarray:
    """Rodrigues' formula for one vector."""
    angle = np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    cross = np.zeros((3, 3))
    cross[0, 1], cross[0, 2] = -vector[2], vector[1]
    cross[1, 0], cross[1, 2] = vector[2], -vector[0]
    cross[2, 0], cross[2, 1] = -vector[1], vector[0]
    first = np.sin(angle) / angle if angle > 1e-8 else 1.0
    second = (1 - np.cos(angle)) / angle**2 if angle > 1e-8 else 0.5
    return np.eye(3) + first * cross + second * (cross @ cross)
