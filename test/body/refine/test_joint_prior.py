# SPDX-License-Identifier: Apache-2.0
"""The edge prior against numerical derivatives."""

import numpy as np
import pytest

from flowing_puppet_ros.body.refine.joint_prior import inverse_left_jacobian, joint_quadratic
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.gaussian import Gaussian

STEP = 1e-6


@pytest.mark.parametrize("scale", [0.0, 1e-5, 0.3, 1.5, 3.0])
def test_inverse_left_jacobian_equals_numerical_derivative(scale: float) -> None:
    r = scale * np.array([0.6, -0.64, 0.48])
    numerical = np.stack(
        [
            (so3.log(so3.exp(row) @ so3.exp(r)) - so3.log(so3.exp(-row) @ so3.exp(r))) / (2 * STEP)
            for row in STEP * np.eye(3)
        ],
        axis=1,
    )
    np.testing.assert_allclose(inverse_left_jacobian(r), numerical, atol=1e-6)


def test_gradient_equals_numerical_derivative() -> None:
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(8, 8))
    gaussian = Gaussian(0.2 * rng.normal(size=8), factor @ factor.T)
    precision = np.linalg.inv(gaussian.covariance + 0.01 * np.eye(8))
    parent, child = so3.exp(rng.normal(size=3)), so3.exp(rng.normal(size=3))
    child = parent @ so3.exp(np.array([0.4, 0.2, -0.3])) @ so3.exp(0.2 * rng.normal(size=3))
    poses = rng.normal(size=5)

    def cost(step: np.ndarray) -> float:
        rotation = so3.log((parent @ so3.exp(step[:3])).T @ child @ so3.exp(step[3:6]))
        deviation = np.concatenate([rotation, poses + step[6:]]) - gaussian.mean
        return float(0.5 * deviation @ precision @ deviation)

    relative = so3.log(parent.T @ child)
    hessian, gradient = joint_quadratic(relative, np.concatenate([relative, poses]) - gaussian.mean, precision)
    numerical = [(cost(row) - cost(-row)) / (2 * STEP) for row in STEP * np.eye(11)]
    np.testing.assert_allclose(gradient, numerical, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-9)
    assert np.linalg.eigvalsh(hessian).min() > -1e-9
