# SPDX-License-Identifier: Apache-2.0
"""Learn the second look at candidates: trees that tell people from what the rigid filters take for people."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.image.detector.boosted_trees import BoostedTrees, quantise_features
from flowing_puppet_ros.image.detector.proposals import propose
from flowing_puppet_ros.image.detector.root_filters import COLUMNS, PAD, ROWS, STEP, RootFilters, make_level
from flowing_puppet_ros.learn.detector.boosting import boost
from flowing_puppet_ros.learn.detector.data import Example, center_of, close_to, varied

VARIANTS = 3  # of a true window: mirrored, blurred, brighter, off by half a cell and half a level
NEGATIVES = 15  # candidates of an example that show nobody
SEARCHED = 2  # of so many examples one is searched for candidates
TRUE_CENTER, TRUE_SCALE = 0.25, 1.2  # units of S and ratio: a candidate this close is a further positive


def learn_forest(
    examples: Sequence[Example], root: RootFilters, trees: int, seed: int, report: Callable[[str], None]
) -> BoostedTrees:
    """Trees from the examples' true windows and from the candidates that the rigid filters find on them."""
    rng = np.random.default_rng(seed)
    codes: list[Array] = []
    positive: list[bool] = []
    for index, example in enumerate(examples):
        for _ in range(VARIANTS):
            shown = varied(example, rng)
            codes.append(_true_window(shown, rng))
            positive.append(True)
        if index % SEARCHED == 0:
            for window, right in _candidates(shown, root):
                codes.append(window)
                positive.append(right)
    labels = np.array(positive)
    report(f"second look: {labels.sum()} positive, {(~labels).sum()} negative windows")
    return boost(np.array(codes), labels, np.ones(len(labels)), rng, trees)


def _true_window(example: Example, rng: np.random.Generator) -> Array:
    at = make_level(example.image, example.scale * STEP ** rng.uniform(-0.5, 0.5))
    x, y = center_of(example) + 0.5
    row, column = round(y / at.cell - ROWS / 2) + PAD, round(x / at.cell - COLUMNS / 2) + PAD
    return quantise_features(at.features, at.colours, row, column)


def _candidates(example: Example, root: RootFilters) -> list[tuple[Array, bool]]:
    """Codes of candidates that surely show the person, and of those that surely do not, at most NEGATIVES."""
    found: list[tuple[Array, bool]] = []
    wrong = 0
    for one in propose(example.image, root, max(10.0, max(example.image.shape[:2]) / 20)):
        if close_to(example, one.center, one.scale, TRUE_CENTER, TRUE_SCALE):
            found.append((one.codes, True))
        elif wrong < NEGATIVES and not close_to(example, one.center, one.scale):
            found.append((one.codes, False))
            wrong += 1
    return found
