# SPDX-License-Identifier: Apache-2.0
"""Gradient boosting of complete decision trees on quantised features, with logistic loss and Newton steps.

J. Friedman: Greedy Function Approximation, 2001; second-order as T. Chen and C. Guestrin: XGBoost, 2016. Each tree
chooses among a random share of the features. scikit-learn's HistGradientBoostingClassifier could do this, but would not
reproduce the shipped weights.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.image.detector.boosted_trees import BINS, BoostedTrees

DEPTH = 3  # levels of splits in each tree
SHRINKAGE = 0.1  # learning rate: factor of each tree's leaves
RIDGE = 5.0  # L2 penalty of the leaves
FEATURE_SHARE = 1 / 16  # of all features, drawn for each tree
MIN_CHILD_HESSIAN = 2.0  # in either child of a split


def boost(codes: Array, positive: Array, weight: Array, rng: np.random.Generator, trees: int) -> BoostedTrees:
    """Train trees to classify windows `codes` (N, F) uint8 as `positive` (N,) bool, with sample weights (N,)."""
    columns = np.ascontiguousarray(codes.T)
    count, samples = columns.shape
    chosen_count = max(1, round(count * FEATURE_SHARE))
    inner = 2**DEPTH - 1
    feature, threshold = np.zeros((trees, inner), np.int32), np.full((trees, inner), BINS, np.uint8)
    leaves = np.zeros((trees, inner + 1), np.float32)
    scores = np.zeros(samples)
    for tree in range(trees):
        probability = 1 / (1 + np.exp(-scores))
        gradient = (weight * (positive - probability)).astype(np.float32)
        hessian = (weight * probability * (1 - probability)).astype(np.float32)
        chosen = rng.choice(count, chosen_count, replace=False).astype(np.int32)
        node = np.zeros(samples, np.int64)
        for level in range(DEPTH):
            start = 2**level - 1
            histogram = _make_histogram(columns, chosen, node - start, gradient, hessian, 2**level)
            for k in range(2**level):
                best = _find_best_split(histogram[k])
                if best is not None:
                    feature[tree, start + k], threshold[tree, start + k] = chosen[best[0]], best[1]
            node = 2 * node + 1 + (columns[feature[tree, node], np.arange(samples)] > threshold[tree, node])
        sums = np.bincount(node - inner, gradient, inner + 1), np.bincount(node - inner, hessian, inner + 1)
        leaves[tree] = SHRINKAGE * sums[0] / (sums[1] + RIDGE)
        scores += leaves[tree, node - inner]
    return BoostedTrees(feature, threshold, leaves)


def _find_best_split(histogram: Array) -> tuple[int, int] | None:
    """Return column and last left code of the best split, given sums (columns, BINS, 2); None if it does not help."""
    left = histogram.cumsum(axis=1)[:, :-1]
    total = histogram[0].sum(axis=0)
    right = total - left
    gain = left[..., 0] ** 2 / (left[..., 1] + RIDGE) + right[..., 0] ** 2 / (right[..., 1] + RIDGE)
    gain[(left[..., 1] < MIN_CHILD_HESSIAN) | (right[..., 1] < MIN_CHILD_HESSIAN)] = -np.inf
    column, code = np.unravel_index(int(gain.argmax()), gain.shape)
    if gain[column, code] <= total[0] ** 2 / (total[1] + RIDGE):
        return None
    return int(column), int(code)


@njit(cache=True, nogil=True)
def _make_histogram(columns: Array, chosen: Array, node: Array, gradient: Array, hessian: Array, nodes: int) -> Any:
    """Sum gradients and Hessians by node, feature and code; return (nodes, chosen, BINS, 2)."""
    out = np.zeros((nodes, len(chosen), BINS, 2), np.float64)
    for k in range(len(chosen)):
        codes = columns[chosen[k]]
        for i in range(len(codes)):
            out[node[i], k, codes[i], 0] += gradient[i]
            out[node[i], k, codes[i], 1] += hessian[i]
    return out
