# SPDX-License-Identifier: Apache-2.0
"""Linear support vector machine with squared hinge loss, by Newton's method in the primal.

O. Chapelle: Training a Support Vector Machine in the Primal, Neural Computation 19, 2007. Exact and without a random
order; it only multiplies matrices, so thousands of dimensions and tens of thousands of samples take seconds.
scikit-learn's LinearSVC could do this, but would not reproduce the shipped weights.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from flowing_puppet_ros.arrays import Array

MAX_NEWTON_STEPS = 15  # a few suffice until the active set is stable


def train(features: Array, positive: Array, weight: Array, ridge: float, start: Array | None = None) -> Array:
    """Minimise ridge |w|^2 + sum of weight * max(0, 1 - y (x w + b))^2 over w (D,) and b; return (D + 1,), b last.

    `features` (N, D) float32, `positive` (N,) bool (y is 1 or -1), `weight` (N,); `start` (D + 1,) initialises.
    """
    count, dimensions = features.shape
    sign = np.where(positive, 1.0, -1.0).astype(np.float32)
    solution = np.zeros(dimensions + 1, np.float32) if start is None else start.astype(np.float32)
    active = np.zeros(count, dtype=bool)
    for step in range(MAX_NEWTON_STEPS):
        margin = sign * (features @ solution[:-1] + solution[-1])
        wrong = margin < 1 if step or start is not None else np.ones(count, dtype=bool)
        if step and np.array_equal(wrong, active):
            break
        active = wrong
        solution = _solve_least_squares(features[active], sign[active], weight[active].astype(np.float32), ridge)
    return solution


def _solve_least_squares(features: Array, target: Array, weight: Array, ridge: float) -> Array:
    """Minimise ridge |w|^2 + sum of weight * (target - x w - b)^2; return (D + 1,), b last."""
    count, dimensions = features.shape
    if count < dimensions:
        # Solve the smaller dual system of the samples' inner products.
        kernel = features @ features.T
        kernel[np.arange(count), np.arange(count)] += ridge / weight
        factor = cho_factor(kernel, lower=True, overwrite_a=True)
        solved = cho_solve(factor, np.column_stack([target, np.ones(count, np.float32)]))
        bias = solved[:, 0].sum() / solved[:, 1].sum()
        return np.append(features.T @ (solved[:, 0] - bias * solved[:, 1]), bias).astype(np.float32)
    weighted = features * weight[:, None]
    normal = np.empty((dimensions + 1, dimensions + 1), np.float32)
    normal[:-1, :-1] = features.T @ weighted
    normal[-1, :-1] = normal[:-1, -1] = weighted.sum(axis=0)
    normal[-1, -1] = weight.sum()
    normal[np.arange(dimensions), np.arange(dimensions)] += ridge
    right = np.append(weighted.T @ target, weight @ target)
    solution: Array = cho_solve(cho_factor(normal, lower=True, overwrite_a=True), right.astype(np.float32))
    return solution
