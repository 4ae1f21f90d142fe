# SPDX-License-Identifier: Apache-2.0
"""Learn the part filters jointly: a structured support vector machine over the tree, by stochastic subgradients.

The filters start as whitened means of every type of every part. Each step compares the true placement of an example
with the best one under loss-augmented inference (exact), and moves the filters along the difference of their features,
preconditioned by the features' covariance. Windows without a person in their middle, or with one of another size, push
scores below a threshold in the same way. The result is the average over the second half of all steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.image.detector.part_filters import (
    COLUMNS,
    FILTER_CELLS,
    PARENTS,
    ROWS,
    FeatureWindow,
    PartFilters,
    extract_window,
    filter_responses,
    pad_half_filter,
)
from flowing_puppet_ros.image.detector.pictorial_structure import (
    FilterTree,
    find_best_placement,
    pass_up,
    score_placement,
)
from flowing_puppet_ros.learn.detector.data import Example, augment
from flowing_puppet_ros.learn.detector.part_types import PartTypes, locate_parts

RIDGE = 0.02  # added to the diagonal of the features' covariance
START_SHARE = 0.05  # factor of the whitened means that the filters start with
LEARNING_RATE = 4e-4  # of the filters, at the first step
BIAS_RATE, TYPE_RATE = 3.0, 20.0  # of biases and type pairs, in units of LEARNING_RATE
BATCH_SIZE = 8  # examples per step
MAX_LOSS_DISTANCE_CELLS = 4.0  # larger errors cost no more
NEGATIVE_PROBABILITY = 0.3  # of a negative window beside a positive one
BACKGROUND_PATCHES = 40  # per example, for the covariance
NECK_JITTER, FACE_JITTER, SCALE_JITTER = 0.08, 0.06, 0.1  # deviations, as the root filters err, in S and log scale


@dataclass(frozen=True, slots=True, eq=False)
class TrainingWindow:
    """An example as the filters see it: window, `truth` (P, 3), layer and cell of each part, and `seen` (P,) bool."""

    window: FeatureWindow
    truth: Array
    seen: Array


def make_training_window(example: Example, types: PartTypes, rng: np.random.Generator) -> TrainingWindow:
    """Cut the window of an example as after an imperfect detection of head and shoulders."""
    example = augment(example, rng)
    scale = example.scale * float(np.exp(rng.normal(0, SCALE_JITTER)))
    neck = example.joint("neck") + rng.normal(0, NECK_JITTER * scale, 2)
    face = example.joint("face") + rng.normal(0, FACE_JITTER * scale, 2)
    window = extract_window(example.image, tuple(neck), tuple(face), scale)
    nodes, seen = locate_parts(example)
    cells = np.round(window.to_cells(nodes)).astype(np.int64)
    seen &= ((cells >= 0) & (cells < (COLUMNS, ROWS))).all(axis=1)
    cells = np.clip(cells, 0, (COLUMNS - 1, ROWS - 1))
    return TrainingWindow(window, np.column_stack([types.assign_layers(nodes / example.scale), cells]), seen)


def make_negative_window(example: Example, rng: np.random.Generator) -> FeatureWindow:
    """Cut a window beside the person of an example, or at a wrong scale."""
    example = augment(example, rng)
    scale, neck = example.scale, example.joint("neck")
    if rng.random() < 0.6:
        scale *= float(np.exp(rng.choice([-1, 1]) * rng.uniform(0.3, 1.0)))
        face_step = (example.joint("face") - neck) * (scale / example.scale)
        neck = neck + rng.normal(0, 0.3 * example.scale, 2)
    else:
        scale *= float(np.exp(rng.uniform(-1.2, 0.5)))
        height, width = example.image.shape[:2]
        face_step = np.array([0.0, -0.4 * scale])
        for _ in range(10):
            neck = rng.uniform((0, 0), (width, height))
            if np.linalg.norm(neck - example.joint("neck")) > 1.2 * max(scale, example.scale):
                break
        else:
            scale = 0.4 * example.scale
    return extract_window(example.image, tuple(neck), tuple(neck + face_step), scale)


def learn_part_filters(
    examples: Sequence[Example], steps: int, seed: int, report: Callable[[str], None]
) -> PartFilters:
    """Learn types, springs and filters from the examples in `steps` steps of BATCH_SIZE windows."""
    rng = np.random.default_rng(seed)
    types = PartTypes.learn(examples, rng)
    model = _StructuredSvm(types, [make_training_window(example, types, rng) for example in examples], rng)
    report(f"parts: {types.tree.first[-1]} filters from {len(examples)} people")
    order = np.concatenate([rng.permutation(len(examples)) for _ in range(steps * BATCH_SIZE // len(examples) + 1)])
    loss = 0.0
    for step in range(steps):
        for index in order[step * BATCH_SIZE : (step + 1) * BATCH_SIZE]:
            example = examples[index]
            if rng.random() < NEGATIVE_PROBABILITY:
                model.add_negative(make_negative_window(example, rng))
            loss += 0.01 * (model.add_positive(make_training_window(example, types, rng)) - loss)
        model.step(1 / (1 + 4 * step / steps), average=step >= steps // 2)
        if (step + 1) % max(1, steps // 10) == 0:
            report(f"parts: step {step + 1} of {steps}, augmented loss {loss:.2f}")
    return model.average()


class _StructuredSvm:
    """Filters and biases in training, with the subgradient of the current batch."""

    def __init__(self, types: PartTypes, windows: Sequence[TrainingWindow], rng: np.random.Generator) -> None:
        """Start from the whitened means of the patches around the parts of the training windows."""
        layers = int(types.tree.first[-1])
        size = FILTER_CELLS * FILTER_CELLS * windows[0].window.features.shape[2]
        sums, counts, background = np.zeros((layers, size)), np.zeros(layers), []
        for sample in windows:
            around = _extract_patches(sample.window)
            background.append(
                around[rng.integers(0, ROWS, BACKGROUND_PATCHES), rng.integers(0, COLUMNS, BACKGROUND_PATCHES)]
            )
            for layer, x, y in sample.truth[sample.seen]:
                sums[layer] += around[y, x].ravel()
                counts[layer] += 1
        patches = np.concatenate(background).reshape(-1, size)
        mean = patches.mean(axis=0)
        centred = patches - mean
        self.whiten = cho_factor(centred.T @ centred / len(centred) + RIDGE * np.eye(size))
        means = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None] - mean, 0.0)
        self.weights = (START_SHARE * cho_solve(self.whiten, means.T).T).astype(np.float32)
        self.tree = types.tree
        self.bias = types.tree.bias.astype(np.float64).copy()
        self.bias[: types.tree.first[1], 0] -= self._estimate_threshold(windows)
        self.sum_weights, self.sum_bias = np.zeros(self.weights.shape), np.zeros(self.bias.shape)
        self.averaged_steps = 0
        self._reset_gradient()

    def _estimate_threshold(self, windows: Sequence[TrainingWindow]) -> float:
        """Return the initial threshold: the median score of the true placements, less 2."""
        return float(np.median([self._score(sample) for sample in windows[:100]])) - 2.0

    def _score(self, sample: TrainingWindow) -> float:
        return score_placement(self._make_tree(), self._compute_responses(sample.window), sample.truth)

    def _reset_gradient(self) -> None:
        self.gradient, self.bias_gradient = np.zeros(self.weights.shape, np.float32), np.zeros(self.bias.shape)

    def _make_tree(self) -> FilterTree:
        tree = self.tree
        return FilterTree(tree.parents, tree.first, tree.anchor, tree.spring, self.bias.astype(np.float32))

    def _compute_responses(self, window: FeatureWindow) -> Array:
        return filter_responses(
            window.features, self.weights.reshape(len(self.weights), FILTER_CELLS, FILTER_CELLS, -1)
        )

    def add_positive(self, sample: TrainingWindow) -> float:
        """Add the subgradient of one example; return its loss-augmented loss."""
        unary = self._compute_responses(sample.window)
        tree = self._make_tree()
        true_score = score_placement(tree, unary, sample.truth)
        augmented = unary + _compute_losses(sample, tree)
        wrong = find_best_placement(tree, pass_up(tree, augmented))
        # Unseen parts have no true placement to compare with.
        known = np.flatnonzero(sample.seen)
        around = pad_half_filter(sample.window.features)
        self._add(around, sample.truth, known, 1.0)
        self._add(around, wrong, known, -1.0)
        if true_score < 1:
            self._add(around, sample.truth, known, 0.3)
        return score_placement(tree, augmented, wrong) - true_score

    def add_negative(self, window: FeatureWindow) -> None:
        """Add the subgradient of a window that shows no person."""
        unary = self._compute_responses(window)
        tree = self._make_tree()
        found = find_best_placement(tree, pass_up(tree, unary))
        if score_placement(tree, unary, found) > -1:
            self._add(pad_half_filter(window.features), found, np.arange(len(found)), -0.3)

    def _add(self, around: Array, placement: Array, parts: Array, sign: float) -> None:
        """Add the features of some parts of a placement, times `sign`."""
        present = set(parts.tolist())
        for part in parts:
            layer, x, y = placement[part]
            self.gradient[layer] += np.float32(sign) * around[y : y + FILTER_CELLS, x : x + FILTER_CELLS].ravel()
            parent = PARENTS[part]
            if parent < 0:
                self.bias_gradient[layer, 0] += sign * BIAS_RATE
            elif parent in present:
                self.bias_gradient[layer, placement[parent, 0] - self.tree.first[parent]] += sign * TYPE_RATE

    def step(self, factor: float, average: bool) -> None:
        """Take one step along the gradient of the batch."""
        self.weights += (LEARNING_RATE * factor) * cho_solve(self.whiten, self.gradient.T).T.astype(np.float32)
        self.bias += LEARNING_RATE * factor * self.bias_gradient
        self._reset_gradient()
        if average:
            self.sum_weights += self.weights
            self.sum_bias += self.bias
            self.averaged_steps += 1

    def average(self) -> PartFilters:
        """Return the model averaged over the steps that were marked for it."""
        count = max(1, self.averaged_steps)
        weights, bias = self.sum_weights / count, self.sum_bias / count
        tree = self.tree
        filters = weights.astype(np.float32).reshape(len(weights), FILTER_CELLS, FILTER_CELLS, -1)
        return PartFilters(
            filters, FilterTree(tree.parents, tree.first, tree.anchor, tree.spring, bias.astype(np.float32))
        )


def _extract_patches(window: FeatureWindow) -> Array:
    """Return all patches (ROWS, COLUMNS, 5, 5, D) that the filters see, as a view of the padded features."""
    views = np.lib.stride_tricks.sliding_window_view(
        pad_half_filter(window.features), (FILTER_CELLS, FILTER_CELLS), axis=(0, 1)
    )
    return views.transpose(0, 1, 3, 4, 2)


def _compute_losses(sample: TrainingWindow, tree: FilterTree) -> Array:
    """Return the loss (L, ROWS, COLUMNS) of placing each layer in each cell, growing with distance up to 1."""
    y, x = np.indices((ROWS, COLUMNS))
    losses = np.zeros((int(tree.first[-1]), ROWS, COLUMNS), np.float32)
    for part in np.flatnonzero(sample.seen):
        distance = np.hypot(x - sample.truth[part, 1], y - sample.truth[part, 2])
        losses[tree.first[part] : tree.first[part + 1]] = np.minimum(1, distance / MAX_LOSS_DISTANCE_CELLS)
    return losses
