# SPDX-License-Identifier: Apache-2.0
"""Logistic regression with a ridge, by Newton's method: turns measures into the probability of being right."""

from __future__ import annotations

from typing import Any

import numpy as np

type Array = np.ndarray[Any, Any]

STEPS = 30


def logistic(measures: Array, right: Array, ridge: float = 1.0) -> tuple[Array, float]:
    """Weights (D,) and bias of the log-odds that samples `measures` (N, D) are `right` (N,).

    The ridge acts on weights of standardised measures; the mean prediction equals the share that is right.
    """
    mean, deviation = measures.mean(axis=0), np.maximum(measures.std(axis=0), 1e-9)
    x = np.column_stack([(measures - mean) / deviation, np.ones(len(measures))])
    penalty = np.append(np.full(x.shape[1] - 1, ridge), 1e-6)
    solution = np.zeros(x.shape[1])
    for _ in range(STEPS):
        probability = 1 / (1 + np.exp(-np.clip(x @ solution, -30, 30)))
        gradient = x.T @ (right - probability) - penalty * solution
        curvature = (x * (probability * (1 - probability))[:, None]).T @ x + np.diag(penalty)
        step = np.linalg.solve(curvature, gradient)
        solution += step * min(1.0, 5 / max(1e-9, float(np.abs(step).max())))
        if np.abs(step).max() < 1e-8:
            break
    weight = solution[:-1] / deviation
    return weight, float(solution[-1] - weight @ mean)
