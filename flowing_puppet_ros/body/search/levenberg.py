# SPDX-License-Identifier: Apache-2.0
"""Levenberg-Marquardt moves that fit every new particle to its closest cloud points (thesis Eqs. 55-64).

The unknowns are rotation, translation and pose deformation. Residuals are taken in the part's own frame, which leaves
the sum of squares as it is: with y = R^T (v - o) for cloud point v and p for the model point in that frame the
residual is p - y, its derivative with respect to a rotation increment on the right of R is -[p]x, with respect to the
translation (in the part's frame) the identity, and with respect to the deformation the constant basis.

The thesis damps with lambda I and weighs every residual alike. Here the damping is scaled by the diagonal of J J^T
(Marquardt 1963), so that radians, metres and coefficients are damped alike; points whose normals contradict the
cloud's count less, joint targets count too, and a weak prior keeps the deformation bounded.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import njit

from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.body.search.part_points import PartPoints
from flowing_puppet_ros.body.search.particles import Particles
from flowing_puppet_ros.evidence.cloud.data_term import CloudGrid, look_up
from flowing_puppet_ros.model.rotation import exp_one
from flowing_puppet_ros.model.sp import MAX_DEVIATIONS

INITIAL_DAMPING = 0.1  # relative to the diagonal of J J^T
DAMPING_FACTOR = 10.0  # by which it falls after a step that helps and grows after one that does not
MAX_ROTATION_STEP_RAD = 0.6  # longer steps are shortened as a whole
POSE_PRIOR_WEIGHT = 5e-5  # of the squared pose coefficients, in square metres
CONTRADICTING_WEIGHT = 0.3  # factor of points whose normals contradict the cloud's
# Points, normals, nearest indices, origin and cell of a CloudGrid.
CloudArrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]
# Basis (K, D, 3), normals and weights of the surface points and then the joints, the joints' targets, and the weighted
# sums over all points of the basis (D, 3) and of its products (D, D).
PartArrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
Triple = tuple[float, float, float]


def levenberg_marquardt(
    points: PartPoints, particles: Particles, grid: CloudGrid, targets: JointTargets, steps: int, count: int
) -> Particles:
    """Run `steps` LM steps (Eqs. 55-64) on every particle of one part; closest points are renewed at each step.

    Args:
        points: the part's points.
        particles: the start.
        grid: the cloud; a closest point whose normal contradicts the model's counts less.
        targets: joint targets.
        steps: steps to try for each particle.
        count: number of surface points to use.

    Returns:
        Particles with the same shape coefficients and a sum of squares that is not larger.
    """
    center, rotation, pose = particles.center.copy(), particles.rotation.copy(), particles.pose.copy()
    mean, part = prepare_part(points, particles, targets, min(count, len(points.surface)))
    cloud = (grid.points, grid.normals, grid.nearest, grid.origin, grid.cell)
    _optimise_all(center, rotation, pose, mean, part, cloud, steps)
    return Particles(center, rotation, pose, particles.shape)


def prepare_part(
    points: PartPoints, particles: Particles, targets: JointTargets, count: int
) -> tuple[np.ndarray, PartArrays]:
    """Return the undeformed points (P, count + M, 3) of every particle, surface before joints, and what all share."""
    surface, joints = points.surface, points.joints
    mean = np.concatenate(
        [surface.apply_shape(particles.shape)[:, :count], joints.apply_shape(particles.shape)], axis=1
    )
    return mean, _share_part(points, targets, count)


@lru_cache(maxsize=64)
def _share_part(points: PartPoints, targets: JointTargets, count: int) -> PartArrays:
    """Return what all particles of a part share, made once in a search."""
    basis = np.concatenate([points.surface.pose_basis[:count], points.joints.pose_basis]).transpose(0, 2, 1).copy()
    weight = np.concatenate([np.full(count, 1.0 / count), targets.weight[points.joint_index]])
    first = np.tensordot(weight, basis, 1)
    second = np.tensordot(basis * weight[:, None, None], basis, axes=([0, 2], [0, 2]))
    target = np.ascontiguousarray(targets.points[points.joint_index])
    return basis, np.ascontiguousarray(points.normals[:count]), weight, target, first, second


@njit(cache=True, nogil=True)
def _optimise_all(
    center: np.ndarray,
    rotation: np.ndarray,
    pose: np.ndarray,
    mean: np.ndarray,
    part: PartArrays,
    cloud: CloudArrays,
    steps: int,
) -> None:
    unknowns = 6 + pose.shape[1]
    hessian, gradient = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    new_hessian, new_gradient = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    step, factor = np.zeros(unknowns), np.zeros((unknowns, unknowns))
    for p in range(len(center)):
        damping = INITIAL_DAMPING
        cost = assemble(center[p], rotation[p], pose[p], mean[p], part, cloud, hessian, gradient)
        for _ in range(steps):
            _solve(hessian, gradient, damping, factor, step)
            angle = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
            if angle > MAX_ROTATION_STEP_RAD:
                step *= MAX_ROTATION_STEP_RAD / angle
            new_center = center[p] + rotation[p] @ step[3:6]
            new_rotation = rotation[p] @ exp_one(step[:3])
            new_pose = np.minimum(np.maximum(pose[p] + step[6:], -MAX_DEVIATIONS), MAX_DEVIATIONS)
            new_cost = assemble(new_center, new_rotation, new_pose, mean[p], part, cloud, new_hessian, new_gradient)
            if new_cost < cost:
                center[p], rotation[p], pose[p], cost = new_center, new_rotation, new_pose, new_cost
                hessian, new_hessian = new_hessian, hessian
                gradient, new_gradient = new_gradient, gradient
                damping /= DAMPING_FACTOR
            else:
                damping *= DAMPING_FACTOR


@njit(cache=True, nogil=True)
def assemble(
    center: np.ndarray,
    rotation: np.ndarray,
    pose: np.ndarray,
    mean: np.ndarray,
    part: PartArrays,
    cloud: CloudArrays,
    hessian: np.ndarray,
    gradient: np.ndarray,
) -> float:
    """Fill the normal equations (the lower triangle) and return half the weighted sum of squares (Eq. 55).

    The unknowns are increments of rotation and translation in the part's own frame, then the deformation. What all
    particles share comes as sums with the part, from which points that contradict the cloud are subtracted in part.
    """
    basis, normals, weight, target, first, second = part
    points, point_normals, nearest, origin, cell = cloud
    deformations = len(pose)
    gradient[:] = 0.0
    hessian[:6, :6] = 0.0
    hessian[6:, :3] = 0.0
    hessian[6:, 3:6] = first
    hessian[6:, 6:] = second
    cost = 0.0
    for k in range(len(mean)):
        x, y, z = mean[k, 0], mean[k, 1], mean[k, 2]
        for d in range(deformations):
            x += basis[k, d, 0] * pose[d]
            y += basis[k, d, 1] * pose[d]
            z += basis[k, d, 2] * pose[d]
        a = center[0] + rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
        b = center[1] + rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
        c = center[2] + rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
        importance = weight[k]
        if k < len(normals):
            found = look_up(nearest, origin, cell, a, b, c)
            a, b, c = a - points[found, 0], b - points[found, 1], c - points[found, 2]
            if _contradicts(rotation, normals[k], point_normals[found]):
                importance *= CONTRADICTING_WEIGHT
                _subtract_deformation(weight[k] - importance, basis[k], hessian)
        else:
            goal = target[k - len(normals)]
            a, b, c = a - goal[0], b - goal[1], c - goal[2]
        u = rotation[0, 0] * a + rotation[1, 0] * b + rotation[2, 0] * c
        v = rotation[0, 1] * a + rotation[1, 1] * b + rotation[2, 1] * c
        w = rotation[0, 2] * a + rotation[1, 2] * b + rotation[2, 2] * c
        cost += 0.5 * importance * (u * u + v * v + w * w)
        _add_rigid(importance, (x, y, z), (u, v, w), hessian, gradient)
        _add_deformed(importance, (x, y, z), (u, v, w), basis[k], hessian, gradient)
    for d in range(deformations):
        cost += 0.5 * POSE_PRIOR_WEIGHT * pose[d] ** 2
        hessian[6 + d, 6 + d] += POSE_PRIOR_WEIGHT
        gradient[6 + d] += POSE_PRIOR_WEIGHT * pose[d]
    return cost


@njit(cache=True, nogil=True, inline="always")
def _contradicts(rotation: np.ndarray, normal: np.ndarray, found: np.ndarray) -> bool:
    """Return whether the part's rotated normal is more than 90 degrees from the cloud's."""
    cosine = 0.0
    for axis in range(3):
        rotated = rotation[axis, 0] * normal[0] + rotation[axis, 1] * normal[1] + rotation[axis, 2] * normal[2]
        cosine += found[axis] * rotated
    return cosine < 0.0


@njit(cache=True, nogil=True)
def _subtract_deformation(weight: float, basis: np.ndarray, hessian: np.ndarray) -> None:
    """Subtract `weight` times one point's deformation from the sums over all points."""
    for d in range(len(basis)):
        for axis in range(3):
            hessian[6 + d, 3 + axis] -= weight * basis[d, axis]
        for e in range(d + 1):
            product = basis[d, 0] * basis[e, 0] + basis[d, 1] * basis[e, 1] + basis[d, 2] * basis[e, 2]
            hessian[6 + d, 6 + e] -= weight * product


@njit(cache=True, nogil=True, inline="always")
def _add_rigid(weight: float, point: Triple, residual: Triple, hessian: np.ndarray, gradient: np.ndarray) -> None:
    """Add a point's J^T W J and J^T W r of rotation and place (Eqs. 56-61), J = (-[p]x, I)."""
    x, y, z = point
    u, v, w = residual
    gradient[0] += weight * (y * w - z * v)
    gradient[1] += weight * (z * u - x * w)
    gradient[2] += weight * (x * v - y * u)
    gradient[3] += weight * u
    gradient[4] += weight * v
    gradient[5] += weight * w
    hessian[0, 0] += weight * (y * y + z * z)
    hessian[1, 1] += weight * (x * x + z * z)
    hessian[2, 2] += weight * (x * x + y * y)
    hessian[1, 0] -= weight * x * y
    hessian[2, 0] -= weight * x * z
    hessian[2, 1] -= weight * y * z
    hessian[3, 1] += weight * z
    hessian[3, 2] -= weight * y
    hessian[4, 0] -= weight * z
    hessian[4, 2] += weight * x
    hessian[5, 0] += weight * y
    hessian[5, 1] -= weight * x
    hessian[3, 3] += weight
    hessian[4, 4] += weight
    hessian[5, 5] += weight


@njit(cache=True, nogil=True, inline="always")
def _add_deformed(
    weight: float, point: Triple, residual: Triple, basis: np.ndarray, hessian: np.ndarray, gradient: np.ndarray
) -> None:
    """Add a point's deformation (Eqs. 62 and 63): its gradient, and its products with the rotation."""
    x, y, z = point
    u, v, w = residual
    for d in range(len(basis)):
        i, j, k = weight * basis[d, 0], weight * basis[d, 1], weight * basis[d, 2]
        gradient[6 + d] += i * u + j * v + k * w
        hessian[6 + d, 0] += y * k - z * j
        hessian[6 + d, 1] += z * i - x * k
        hessian[6 + d, 2] += x * j - y * i


@njit(cache=True, nogil=True)
def _solve(hessian: np.ndarray, gradient: np.ndarray, damping: float, factor: np.ndarray, step: np.ndarray) -> None:
    """Solve (H + damping diag H) step = -g (Eq. 64) for `step` by Cholesky; only the lower triangle of H is read."""
    unknowns = len(gradient)
    for row in range(unknowns):
        total = -gradient[row]
        for column in range(row + 1):
            value = hessian[row, column]
            if row == column:
                value += damping * value + 1e-9
            for k in range(column):
                value -= factor[row, k] * factor[column, k]
            if row == column:
                factor[row, row] = np.sqrt(max(value, 1e-12))
            else:
                factor[row, column] = value / factor[column, column]
                total -= factor[row, column] * step[column]
        step[row] = total / factor[row, row]
    for row in range(unknowns - 1, -1, -1):
        for k in range(row + 1, unknowns):
            step[row] -= factor[k, row] * step[k]
        step[row] /= factor[row, row]
