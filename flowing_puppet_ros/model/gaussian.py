# SPDX-License-Identifier: Apache-2.0
"""Multivariate Gaussians: conditioning, marginals and sampling (thesis Eqs. 12-14)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import Array


@dataclass(frozen=True, slots=True, eq=False)
class Gaussian:
    """N(x; `mean` (D,), `covariance` (D, D)), in the units of x."""

    mean: Array
    covariance: Array

    def __post_init__(self) -> None:
        """Store float64 arrays; ValueError when their shapes do not agree."""
        mean = np.asarray(self.mean, dtype=np.float64)
        covariance = np.asarray(self.covariance, dtype=np.float64)
        if mean.ndim != 1 or covariance.shape != (mean.size, mean.size):
            raise ValueError(f"a mean of shape {mean.shape} and a covariance of shape {covariance.shape} do not agree")
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "covariance", covariance)

    def __len__(self) -> int:
        return int(self.mean.size)

    @classmethod
    def from_samples(cls, samples: Array, ridge: float = 0.0) -> Gaussian:
        """Fit mean and (n - 1)-normalised covariance to `samples` (n, D), with `ridge` added to the variances."""
        centred = samples - samples.mean(axis=0)
        covariance = centred.T @ centred / max(len(samples) - 1, 1)
        return cls(samples.mean(axis=0), covariance + ridge * np.eye(samples.shape[1]))

    def marginal(self, indices: Sequence[int] | Array) -> Gaussian:
        """Return the distribution of the variables `indices`, in that order."""
        kept = np.asarray(indices, dtype=np.intp)
        return Gaussian(self.mean[kept], self.covariance[np.ix_(kept, kept)])

    def condition(self, kept: Sequence[int] | Array, given: Sequence[int] | Array, values: Array) -> Gaussian:
        """Return the distribution of the variables `kept` when the variables `given` have `values` (Eqs. 13 and 14).

        Variables in neither list are marginalised out.
        """
        gain, covariance = self._regress(kept, given)
        values = np.asarray(values, dtype=np.float64)
        mean = self.mean[np.asarray(kept, dtype=np.intp)] + gain @ (
            values - self.mean[np.asarray(given, dtype=np.intp)]
        )
        return Gaussian(mean, covariance)

    def make_conditional(self, kept: Sequence[int] | Array, given: Sequence[int] | Array) -> tuple[Array, Array, Array]:
        """Return `condition` for any values: the mean (K,) at values of zero, its slope (K, G), and axes (K, K).

        A sample is the mean plus the axes times standard normal numbers.
        """
        gain, covariance = self._regress(kept, given)
        mean = self.mean[np.asarray(kept, dtype=np.intp)] - gain @ self.mean[np.asarray(given, dtype=np.intp)]
        return mean, gain, _scaled_axes(covariance)

    def _regress(self, kept: Sequence[int] | Array, given: Sequence[int] | Array) -> tuple[Array, Array]:
        """Return the slope (K, G) of the variables `kept` on the variables `given`, and the covariance that is left."""
        a, b = np.asarray(kept, dtype=np.intp), np.asarray(given, dtype=np.intp)
        gain = np.linalg.solve(self.covariance[np.ix_(b, b)], self.covariance[np.ix_(b, a)]).T
        covariance = self.covariance[np.ix_(a, a)] - gain @ self.covariance[np.ix_(b, a)]
        return gain, (covariance + covariance.T) / 2

    def sample(self, rng: np.random.Generator, n: int) -> Array:
        """Draw samples (n, D); a singular covariance is allowed."""
        return np.asarray(self.mean + rng.standard_normal((n, len(self))) @ _scaled_axes(self.covariance).T)


def _scaled_axes(covariance: Array) -> Array:
    """Return the axes (D, D), in columns, of a covariance, each as long as its standard deviation."""
    variances, axes = np.linalg.eigh(covariance)
    return np.asarray(axes * np.sqrt(np.maximum(variances, 0.0)))
