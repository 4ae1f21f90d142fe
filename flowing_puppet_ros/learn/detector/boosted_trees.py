# SPDX-License-Identifier: Apache-2.0
"""Learn the trees that rescore candidates: they separate people from false positives of the rigid filters."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.image.detector.boosted_trees import BoostedTrees, quantise_features
from flowing_puppet_ros.image.detector.proposals import propose
from flowing_puppet_ros.image.detector.root_filters import (
    COLUMNS,
    LEVEL_FACTOR,
    PAD_CELLS,
    ROWS,
    RootFilters,
    make_level,
)
from flowing_puppet_ros.learn.detector.boosting import boost
from flowing_puppet_ros.learn.detector.data import Example, augment, is_close, window_center

VARIANTS_PER_EXAMPLE = 3  # of true windows: mirrored, blurred, brightened, shifted by up to half a cell and level
MAX_NEGATIVES = 15  # per example: candidates that show no person
SEARCH_EVERY = 2  # one example in so many is searched for candidates
MAX_TRUE_OFFSET, MAX_TRUE_SCALE_RATIO = 0.25, 1.2  # units of S, and ratio: a candidate this close is positive, too


def learn_boosted_trees(
    examples: Sequence[Example], root: RootFilters, trees: int, seed: int, report: Callable[[str], None]
) -> BoostedTrees:
    """Learn trees from the examples' true windows and from the candidates that the rigid filters find on them."""
    rng = np.random.default_rng(seed)
    codes: list[Array] = []
    positive: list[bool] = []
    for index, example in enumerate(examples):
        for _ in range(VARIANTS_PER_EXAMPLE):
            variant = augment(example, rng)
            codes.append(_quantise_true_window(variant, rng))
            positive.append(True)
        if index % SEARCH_EVERY == 0:
            for window, right in _collect_candidates(variant, root):
                codes.append(window)
                positive.append(right)
    labels = np.array(positive)
    report(f"rescoring: {labels.sum()} positive, {(~labels).sum()} negative windows")
    return boost(np.array(codes), labels, np.ones(len(labels)), rng, trees)


def _quantise_true_window(example: Example, rng: np.random.Generator) -> Array:
    at = make_level(example.image, example.scale * LEVEL_FACTOR ** rng.uniform(-0.5, 0.5))
    x, y = window_center(example) + 0.5
    row, column = round(y / at.cell - ROWS / 2) + PAD_CELLS, round(x / at.cell - COLUMNS / 2) + PAD_CELLS
    return quantise_features(at.features, at.colours, row, column)


def _collect_candidates(example: Example, root: RootFilters) -> list[tuple[Array, bool]]:
    """Return the codes of clear positives among the candidates, and of at most MAX_NEGATIVES clear negatives."""
    found: list[tuple[Array, bool]] = []
    wrong = 0
    for candidate in propose(example.image, root, max(10.0, max(example.image.shape[:2]) / 20)):
        if is_close(example, candidate.center, candidate.scale, MAX_TRUE_OFFSET, MAX_TRUE_SCALE_RATIO):
            found.append((candidate.codes, True))
        elif wrong < MAX_NEGATIVES and not is_close(example, candidate.center, candidate.scale):
            found.append((candidate.codes, False))
            wrong += 1
    return found
