# SPDX-License-Identifier: Apache-2.0
"""Gaussian algebra against densities that are computed another way."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from flowing_puppet_ros.model.gaussian import Gaussian, product


@pytest.fixture
def joint() -> Gaussian:
    factor = np.random.default_rng(1).normal(size=(5, 5))
    return Gaussian(np.arange(5.0), factor @ factor.T + 0.1 * np.eye(5))


def test_log_density_agrees_with_scipy(joint: Gaussian) -> None:
    points = np.random.default_rng(2).normal(size=(7, 5)) * 3
    expected = multivariate_normal(joint.mean, joint.covariance).logpdf(points)
    np.testing.assert_allclose(joint.log_density(points), expected)


def test_conditional_is_joint_over_marginal(joint: Gaussian) -> None:
    kept, given = [3, 0], [4, 1]
    values = np.array([2.0, -1.0])
    conditional = joint.condition(kept, given, values)
    for point in np.random.default_rng(3).normal(size=(5, 2)):
        pair = joint.marginal(kept + given).log_density(np.concatenate([point, values]))
        expected = pair - joint.marginal(given).log_density(values)
        np.testing.assert_allclose(conditional.log_density(point), expected)


def test_marginal_is_the_integral_of_the_joint() -> None:
    pair = Gaussian(np.array([0.3, -0.2]), np.array([[1.0, 0.6], [0.6, 0.8]]))
    y = np.linspace(-8, 8, 4001)
    for x in (-1.0, 0.5, 2.0):
        integral = np.exp(pair.log_density(np.stack([np.full_like(y, x), y], axis=1))).sum() * (y[1] - y[0])
        np.testing.assert_allclose(np.exp(pair.marginal([0]).log_density(np.array([x]))), integral, rtol=1e-9)


def test_product_is_the_sum_of_log_densities_up_to_a_constant(joint: Gaussian) -> None:
    other = Gaussian(np.full(5, -1.0), np.diag([1.0, 2.0, 0.5, 4.0, 0.1]))
    points = np.random.default_rng(4).normal(size=(6, 5))
    difference = product([joint, other]).log_density(points) - joint.log_density(points) - other.log_density(points)
    np.testing.assert_allclose(difference, difference[0])


def test_samples_have_the_moments(joint: Gaussian) -> None:
    samples = joint.sample(np.random.default_rng(5), 200_000)
    fitted = Gaussian.from_samples(samples)
    np.testing.assert_allclose(fitted.mean, joint.mean, atol=0.05)
    np.testing.assert_allclose(fitted.covariance, joint.covariance, atol=0.15)


def test_singular_covariance_can_be_sampled() -> None:
    direction = np.array([[1.0, 2.0, -1.0]])
    samples = Gaussian(np.zeros(3), direction.T @ direction).sample(np.random.default_rng(6), 50)
    np.testing.assert_allclose(np.linalg.matrix_rank(samples, tol=1e-6), 1)
    assert samples.std() > 0.1


def test_shapes_that_do_not_belong_together_are_refused() -> None:
    with pytest.raises(ValueError, match="covariance of shape"):
        Gaussian(np.zeros(3), np.eye(2))
