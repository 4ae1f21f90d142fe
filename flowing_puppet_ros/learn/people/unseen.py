# SPDX-License-Identifier: Apache-2.0
"""Forests, and what they say about scans that they have not learned from."""

from __future__ import annotations

from typing import Any

import numpy as np

TREES, MAX_DEPTH, MIN_LEAF_EXAMPLES, FEATURE_SHARE = 150, 14, 2, 0.5
FOLDS = 5
"""Parts of the scans; what is said about each is learned from the others, so that the odds are those of new scans."""


def predict_unseen(features: np.ndarray, truth: np.ndarray, scan: np.ndarray, seed: int) -> np.ndarray:
    """Return the probability (N,) of a person by forests that have not seen the scan of each example.

    `features` (N, F); `truth` (N,) 1 for a person; `scan` (N,) number of the scan.
    """
    numbers = np.random.default_rng(seed).permutation(np.unique(scan))
    found = np.empty(len(truth))
    for part in np.array_split(numbers, min(FOLDS, len(numbers))):
        unseen = np.isin(scan, part)
        found[unseen] = make_forest(seed).fit(features[~unseen], truth[~unseen]).predict_proba(features[unseen])[:, 1]
    return found


def make_forest(seed: int) -> Any:
    """Make a forest that has learned nothing yet."""
    from sklearn.ensemble import ExtraTreesClassifier

    return ExtraTreesClassifier(
        TREES,
        max_depth=MAX_DEPTH,
        min_samples_leaf=MIN_LEAF_EXAMPLES,
        max_features=FEATURE_SHARE,
        class_weight="balanced",
        random_state=seed,
    )
