# SPDX-License-Identifier: Apache-2.0
"""The prior over relative rotation and deformation of two neighbouring parts (Eq. 49), as a quadratic."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def inverse_left_jacobian(r: np.ndarray) -> np.ndarray:
    """Return the derivative (3, 3) of log(exp(x) exp(r)) with respect to x at 0, for a rotation vector r (3,).

    The derivative of log(exp(r) exp(x)) is its transpose (Barfoot, State Estimation for Robotics, section 7.1.5).
    """
    cross = np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])
    angle = np.sqrt(r[0] ** 2 + r[1] ** 2 + r[2] ** 2)
    half = angle / 2
    factor = 1 / 12 if angle < 1e-4 else (1 - half / np.tan(half)) / angle**2
    return np.eye(3) - 0.5 * cross + factor * (cross @ cross)


@njit(cache=True, nogil=True)
def joint_quadratic(
    relative: np.ndarray, deviation: np.ndarray, precision: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return Hessian and gradient of half the squared Mahalanobis distance of an edge to its Gaussian (Eq. 49).

    Args:
        relative: (3,) rotation vector of the child in the parent's frame.
        deviation: (K,) of that vector, the parent's pose and the child's pose from the mean.
        precision: (K, K), contiguous.

    Returns:
        (K + 3, K + 3) and (K + 3,) over [parent's rotation increment, child's rotation increment (both multiplied on
        the right), parent's pose, child's pose].
    """
    inverse, count = inverse_left_jacobian(relative), len(deviation)
    jacobian = np.zeros((count, count + 3))
    jacobian[:3, :3] = -inverse
    jacobian[:3, 3:6] = inverse.T
    for k in range(3, count):
        jacobian[k, k + 3] = 1.0
    weighted = jacobian.T @ precision
    return weighted @ jacobian, weighted @ deviation
