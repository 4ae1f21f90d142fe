# SPDX-License-Identifier: Apache-2.0
"""How two neighbouring parts are usually turned and deformed, as a quadratic for Gauss-Newton (thesis Eq. 49)."""

from __future__ import annotations

import numpy as np

from flowing_puppet_ros.model.gaussian import Gaussian


def inverse_left_jacobian(r: np.ndarray) -> np.ndarray:
    """Derivative (3, 3) of log(exp(x) exp(r)) with respect to x at 0, for a Rodrigues vector r (3,).

    The derivative of log(exp(r) exp(x)) is its transpose (Barfoot, State Estimation for Robotics, section 7.1.5).
    """
    cross = np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])
    angle = float(np.linalg.norm(r))
    if angle < 1e-4:
        factor = 1 / 12
    else:
        half = angle / 2
        factor = (1 - half / np.tan(half)) / angle**2
    return np.eye(3) - 0.5 * cross + factor * cross @ cross


class JointPrior:
    """The pairwise Gaussian of one edge with a bounded precision, ready for Gauss-Newton."""

    def __init__(self, pairwise: Gaussian, ridge: float = 0.05) -> None:
        self._mean = pairwise.mean
        self._precision = np.linalg.inv(pairwise.covariance + ridge**2 * np.eye(len(pairwise.mean)))

    def quadratic(
        self, relative: np.ndarray, parent_pose: np.ndarray, child_pose: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Hessian and gradient of half the squared Mahalanobis distance.

        Args:
            relative: (3,) Rodrigues vector of the child's rotation in the parent's frame.
            parent_pose: (D,) coefficients.
            child_pose: (D',) coefficients.

        Returns:
            Square matrix and vector over [parent's rotation increment, child's rotation increment (both multiplied
            on the right), parent's pose, child's pose].
        """
        inverse = inverse_left_jacobian(relative)
        deviation = np.concatenate([relative, parent_pose, child_pose]) - self._mean
        jacobian = np.zeros((len(deviation), len(deviation) + 3))
        jacobian[:3, :3] = -inverse
        jacobian[:3, 3:6] = inverse.T
        jacobian[3:, 6:] = np.eye(len(deviation) - 3)
        weighted = jacobian.T @ self._precision
        return weighted @ jacobian, weighted @ deviation
