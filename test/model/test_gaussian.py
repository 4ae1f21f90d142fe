# SPDX-License-Identifier: Apache-2.0
"""Gaussian algebra against densities computed independently."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from flowing_puppet_ros.model.gaussian import Gaussian


@pytest.fixture
def joint() -> Gaussian:
    factor = np.random.default_rng(1).normal(size=(5, 5))
    return Gaussian(np.arange(5.0), factor @ factor.T + 0.1 * np.eye(5))


def log_density(gaussian: Gaussian, x: np.ndarray) -> np.ndarray:
    return np.asarray(multivariate_normal(gaussian.mean, gaussian.covariance).logpdf(x))


def test_conditional_is_joint_over_marginal(joint: Gaussian) -> None:
    kept, given = [3, 0], [4, 1]
    values = np.array([2.0, -1.0])
    conditional = joint.condition(kept, given, values)
    for point in np.random.default_rng(3).normal(size=(5, 2)):
        pair = log_density(joint.marginal(kept + given), np.concatenate([point, values]))
        expected = pair - log_density(joint.marginal(given), values)
        np.testing.assert_allclose(log_density(conditional, point), expected)


def test_conditional_for_any_values_is_that_for_each(joint: Gaussian) -> None:
    kept, given = [3, 0], [4, 1]
    mean, slope, axes = joint.make_conditional(kept, given)
    for values in np.random.default_rng(4).normal(size=(3, 2)):
        conditional = joint.condition(kept, given, values)
        np.testing.assert_allclose(mean + slope @ values, conditional.mean)
        np.testing.assert_allclose(axes @ axes.T, conditional.covariance)


def test_marginal_is_the_integral_of_the_joint() -> None:
    pair = Gaussian(np.array([0.3, -0.2]), np.array([[1.0, 0.6], [0.6, 0.8]]))
    y = np.linspace(-8, 8, 4001)
    for x in (-1.0, 0.5, 2.0):
        integral = np.exp(log_density(pair, np.stack([np.full_like(y, x), y], axis=1))).sum() * (y[1] - y[0])
        np.testing.assert_allclose(np.exp(log_density(pair.marginal([0]), np.array([x]))), integral, rtol=1e-9)


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


def test_shapes_that_do_not_agree_are_refused() -> None:
    with pytest.raises(ValueError, match="covariance of shape"):
        Gaussian(np.zeros(3), np.eye(2))
