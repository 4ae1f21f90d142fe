# SPDX-License-Identifier: Apache-2.0
"""Learn the rigid head-and-shoulders filters from clustered positives, random negatives and mined hard negatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.cluster.vq import kmeans2

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.image.detector.root_filters import (
    COLUMNS,
    LEVEL_FACTOR,
    PAD_CELLS,
    ROWS,
    Level,
    RootFilters,
    correlate,
    make_level,
)
from flowing_puppet_ros.learn.detector.data import Example, augment, is_close, window_center
from flowing_puppet_ros.learn.detector.squared_hinge import train

COMPONENTS = 1  # of the mixture
RIDGE = 100.0  # L2 penalty; features are about 0.2
POSITIVE_WEIGHT = 3.0  # of a positive's loss; 1 for negatives
ROUNDS = 3  # of training, with hard negatives mined between them
NEGATIVES_PER_EXAMPLE = 6  # new ones in each round
SHAPE_JOINTS = ("face", "right_shoulder", "left_shoulder", "right_elbow", "left_elbow")
LEVEL_OFFSETS = range(-6, 7)  # pyramid levels around the person's, for negatives


def learn_root_filters(examples: Sequence[Example], seed: int, report: Callable[[str], None]) -> RootFilters:
    """Learn filters for the examples' heads and shoulders; the biases are those of the support vector machines."""
    rng = np.random.default_rng(seed)
    shown = [augment(example, rng) for example in examples]
    groups, offsets = _cluster_components(shown, rng)
    positives = np.stack([_extract_true_window(example, rng) for example in shown])
    negatives = np.concatenate([_sample_negatives(example, rng) for example in shown])
    solutions: list[Array | None] = [None] * len(offsets)
    for turn in range(ROUNDS):
        solutions = [_train_component(positives[groups == k], negatives, solutions[k]) for k in range(len(offsets))]
        root = _make_filters(solutions, offsets)
        if turn + 1 < ROUNDS:
            hard = np.concatenate([_mine_hard_negatives(example, root, rng) for example in shown])
            negatives = np.concatenate([_keep_hard(negatives, solutions), hard])
            report(f"head and shoulders, round {turn + 1}: {len(positives)} positive, {len(negatives)} negative")
    return root


def _cluster_components(examples: Sequence[Example], rng: np.random.Generator) -> tuple[Array, Array]:
    """Cluster people by face, shoulders and elbows; return components (N,), and median neck and face (K, 2, 2) in S."""
    centers = np.stack([window_center(example) for example in examples])
    scales = np.array([example.scale for example in examples])

    def relative(name: str) -> Array:
        return (np.stack([example.joint(name) for example in examples]) - centers) / scales[:, None]

    shape = np.concatenate([relative(name) * (3 if name == "face" else 1) for name in SHAPE_JOINTS], axis=1)
    _, groups = kmeans2(shape, COMPONENTS, minit="++", seed=rng, iter=50)
    both = np.stack([relative("neck"), relative("face")], axis=1)
    present = [k for k in range(COMPONENTS) if (groups == k).sum() >= 10] or [int(groups[0])]
    groups = np.argmin([[np.square(s - shape[groups == k].mean(axis=0)).sum() for k in present] for s in shape], axis=1)
    return groups, np.stack([np.median(both[groups == k], axis=0) for k in range(len(present))])


def _extract_true_window(example: Example, rng: np.random.Generator) -> Array:
    """Return the features of the person's window, misplaced by up to half a cell and half a level."""
    at = make_level(example.image, example.scale * LEVEL_FACTOR ** rng.uniform(-0.5, 0.5))
    x, y = window_center(example) + 0.5
    column, row = round(x / at.cell - COLUMNS / 2) + PAD_CELLS, round(y / at.cell - ROWS / 2) + PAD_CELLS
    return _extract_window(at, row, column)


def _extract_window(at: Level, row: int, column: int) -> Array:
    """Return the window (ROWS * COLUMNS * 32,) at cell (row, column), padded by repeating the level's border."""
    rows = np.clip(np.arange(row, row + ROWS), 0, at.features.shape[0] - 1)
    columns = np.clip(np.arange(column, column + COLUMNS), 0, at.features.shape[1] - 1)
    return at.features[np.ix_(rows, columns)].ravel()


def _is_near_person(example: Example, at: Level, rows: Array, columns: Array) -> Array:
    """Return whether windows of a level are close to the person in place and scale, or touch another person."""
    x = (columns - PAD_CELLS + COLUMNS / 2) * at.cell - 0.5
    y = (rows - PAD_CELLS + ROWS / 2) * at.cell - 0.5
    return is_close(example, (x, y), at.scale)


def _sample_negatives(example: Example, rng: np.random.Generator) -> Array:
    """Draw windows at random places and scales that show no person."""
    found = []
    for _ in range(2):
        at = make_level(
            example.image, example.scale * LEVEL_FACTOR ** rng.integers(LEVEL_OFFSETS.start, LEVEL_OFFSETS.stop)
        )
        rows = rng.integers(0, max(1, at.features.shape[0] - ROWS + 1), NEGATIVES_PER_EXAMPLE // 2)
        columns = rng.integers(0, max(1, at.features.shape[1] - COLUMNS + 1), NEGATIVES_PER_EXAMPLE // 2)
        near = _is_near_person(example, at, rows, columns)
        found += [_extract_window(at, int(r), int(c)) for r, c in zip(rows[~near], columns[~near], strict=True)]
    return np.array(found, np.float32).reshape(-1, ROWS * COLUMNS * 32)


def _mine_hard_negatives(example: Example, root: RootFilters, rng: np.random.Generator) -> Array:
    """Return the best-scoring windows of three levels that show no person."""
    found: list[tuple[float, Array]] = []
    for step in rng.choice(np.array(LEVEL_OFFSETS), 3, replace=False):
        at = make_level(example.image, example.scale * LEVEL_FACTOR ** float(step))
        scores = (correlate(at.features, root.filters) + root.bias).max(axis=2)
        if not scores.size:
            continue
        grid = np.indices(scores.shape)
        scores[_is_near_person(example, at, grid[0], grid[1])] = -np.inf
        for _ in range(NEGATIVES_PER_EXAMPLE // 2):
            row, column = np.unravel_index(scores.argmax(), scores.shape)
            if scores[row, column] < -1:
                break
            found.append((float(scores[row, column]), _extract_window(at, int(row), int(column))))
            scores[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2] = -np.inf
    best = [window for _, window in sorted(found, key=lambda pair: -pair[0])[:NEGATIVES_PER_EXAMPLE]]
    return np.array(best, np.float32).reshape(-1, ROWS * COLUMNS * 32)


def _keep_hard(negatives: Array, solutions: Sequence[Array | None]) -> Array:
    """Return the negatives that some component scores above -1.1, just outside the margin."""
    best = np.max([negatives @ w[:-1] + w[-1] for w in solutions if w is not None], axis=0)
    return negatives[best > -1.1]


def _train_component(positives: Array, negatives: Array, start: Array | None) -> Array:
    """Train one component; return its weights and bias (D + 1,)."""
    features = np.concatenate([positives, negatives])
    positive = np.arange(len(features)) < len(positives)
    return train(features, positive, np.where(positive, POSITIVE_WEIGHT, 1.0), RIDGE, start)


def _make_filters(solutions: Sequence[Array | None], offsets: Array) -> RootFilters:
    stacked = np.stack([solution for solution in solutions if solution is not None]).astype(np.float32)
    filters = np.ascontiguousarray(stacked[:, :-1].reshape(-1, ROWS, COLUMNS, 32))
    return RootFilters(filters, stacked[:, -1].copy(), offsets.astype(np.float32))
