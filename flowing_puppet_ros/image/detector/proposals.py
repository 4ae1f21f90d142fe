# SPDX-License-Identifier: Apache-2.0
"""From an image to the places where a pose is worth looking for: rigid filters propose, boosted trees choose."""

from __future__ import annotations

import numpy as np

from flowing_puppet_ros.arrays import U8
from flowing_puppet_ros.image.detector.boosted_trees import BoostedTrees
from flowing_puppet_ros.image.detector.root_filters import RootCandidate, RootFilters, scan

WINDOWS = 80  # places that the rigid filters propose
LEAST = -2.0
SCALE_PRIOR = 0.3  # score of the rigid filters per logarithm of S: small windows are many
FOREST_SHARE = 0.33  # units of the rigid filters' score per log-odds of the trees


def propose(image: U8, root: RootFilters, smallest: float) -> list[RootCandidate]:
    """Places of people with shoulders from `smallest` px, those that the rigid filters prefer first."""
    found = scan(image, root, smallest, WINDOWS, LEAST)
    return sorted(found, key=lambda one: -(one.score + SCALE_PRIOR * np.log(one.scale)))


def rescore(candidates: list[RootCandidate], forest: BoostedTrees, count: int) -> list[tuple[RootCandidate, float]]:
    """The `count` most promising candidates with the trees' score of each, best first."""
    if not candidates:
        return []
    looks = forest.scores(np.stack([one.codes for one in candidates]))
    value = [
        one.score + FOREST_SHARE * float(look) + 1.5 * SCALE_PRIOR * np.log(one.scale)
        for one, look in zip(candidates, looks, strict=True)
    ]
    return [(candidates[i], float(looks[i])) for i in np.argsort(-np.array(value), kind="stable")[:count]]
