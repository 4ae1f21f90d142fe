# SPDX-License-Identifier: Apache-2.0
"""From an image to the candidates at which a pose is searched: rigid filters propose, boosted trees choose."""

from __future__ import annotations

import numpy as np

from flowing_puppet_ros.arrays import U8
from flowing_puppet_ros.image.detector.boosted_trees import BoostedTrees
from flowing_puppet_ros.image.detector.root_filters import RootCandidate, RootFilters, scan

MAX_WINDOWS = 80  # candidates that the rigid filters propose
MIN_LOG_ODDS = -2.0  # of a window under the rigid filters
SCALE_PRIOR = 0.3  # score of the rigid filters per logarithm of S, because small windows are many
TREE_WEIGHT = 0.33  # score of the rigid filters per log-odds of the trees


def propose(image: U8, root: RootFilters, min_width: float) -> list[RootCandidate]:
    """Propose people with shoulders of at least `min_width` px, those with the highest prior score first."""
    found = scan(image, root, min_width, MAX_WINDOWS, MIN_LOG_ODDS)
    return sorted(found, key=lambda one: -(one.score + SCALE_PRIOR * np.log(one.scale)))


def rescore(candidates: list[RootCandidate], trees: BoostedTrees, count: int) -> list[tuple[RootCandidate, float]]:
    """Return the `count` most promising candidates with the trees' score of each, best first."""
    if not candidates:
        return []
    tree_scores = trees.score(np.stack([one.codes for one in candidates]))
    value = [
        one.score + TREE_WEIGHT * float(tree_score) + 1.5 * SCALE_PRIOR * np.log(one.scale)
        for one, tree_score in zip(candidates, tree_scores, strict=True)
    ]
    return [(candidates[i], float(tree_scores[i])) for i in np.argsort(-np.array(value), kind="stable")[:count]]
