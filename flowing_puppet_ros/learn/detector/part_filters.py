# SPDX-License-Identifier: Apache-2.0
"""Learn the part filters jointly: a structured support vector machine over the tree, by stochastic subgradients.

Start: whitened means of every type of every part. Then, an example at a time, the placement that scores best with the
errors that it would make added (loss-augmented inference, exact) is compared with the true one, and the filters move
along the difference of their features, preconditioned by the covariance of features. Windows without a person in
their middle, or with one of another size, push scores below a threshold in the same way. What comes out is the
average of the second half of all steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.image.detector.part_filters import (
    COLUMNS,
    FILTER,
    PARENTS,
    ROWS,
    FeatureWindow,
    PartFilters,
    pad_window,
    responses,
    window_at,
)
from flowing_puppet_ros.image.detector.pictorial_structure import FilterTree, best_placement, pass_up, score_of
from flowing_puppet_ros.learn.detector.data import Example, varied
from flowing_puppet_ros.learn.detector.part_types import PartTypes, nodes_of

RIDGE = 0.02  # added to the covariance of features
START = 0.05  # share of the whitened means that the filters start with
RATE = 4e-4
BIAS_RATE, TYPE_RATE = 3.0, 20.0  # times RATE
BATCH = 8
LOSS_CELLS = 4.0  # an error of so many cells costs as much as any larger one
NEGATIVE_SHARE = 0.3
BACKGROUND = 40  # patches of an example for the covariance
PLACE_JITTER, FACE_JITTER, SCALE_JITTER = 0.08, 0.06, 0.1  # as large as errors of the head-and-shoulders filters


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """An example as the filters see it: the window, the true layer and cell (P, 3) and which of the parts were seen."""

    window: FeatureWindow
    truth: Array
    seen: Array


def show(example: Example, types: PartTypes, rng: np.random.Generator) -> Shown:
    """Look at an example as after an imperfect search for the head and shoulders."""
    example = varied(example, rng)
    scale = example.scale * float(np.exp(rng.normal(0, SCALE_JITTER)))
    neck = example.joint("neck") + rng.normal(0, PLACE_JITTER * scale, 2)
    face = example.joint("face") + rng.normal(0, FACE_JITTER * scale, 2)
    window = window_at(example.image, tuple(neck), tuple(face), scale)
    nodes, seen = nodes_of(example)
    cells = np.round(window.cells_of(nodes)).astype(np.int64)
    seen &= ((cells >= 0) & (cells < (COLUMNS, ROWS))).all(axis=1)
    cells = np.clip(cells, 0, (COLUMNS - 1, ROWS - 1))
    return Shown(window, np.column_stack([types.layers_of(nodes / example.scale), cells]), seen)


def show_wrong(example: Example, rng: np.random.Generator) -> FeatureWindow:
    """Look where the person of an example is not, or at a scale that is not theirs."""
    example = varied(example, rng)
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
    return window_at(example.image, tuple(neck), tuple(neck + face_step), scale)


def learn_parts(examples: Sequence[Example], steps: int, seed: int, report: Callable[[str], None]) -> PartFilters:
    """Learn types, springs and filters from the examples in `steps` steps of BATCH windows."""
    rng = np.random.default_rng(seed)
    types = PartTypes.learn(examples, rng)
    model = _Machine(types, [show(example, types, rng) for example in examples], rng)
    report(f"parts: {types.tree.first[-1]} filters from {len(examples)} people")
    order = np.concatenate([rng.permutation(len(examples)) for _ in range(steps * BATCH // len(examples) + 1)])
    loss = 0.0
    for step in range(steps):
        for index in order[step * BATCH : (step + 1) * BATCH]:
            example = examples[index]
            if rng.random() < NEGATIVE_SHARE:
                model.push_down(show_wrong(example, rng))
            loss += 0.01 * (model.compare(show(example, types, rng)) - loss)
        model.move(1 / (1 + 4 * step / steps), average=step >= steps // 2)
        if (step + 1) % max(1, steps // 10) == 0:
            report(f"parts: step {step + 1} of {steps}, augmented loss {loss:.2f}")
    return model.averaged()


class _Machine:
    """Filters and biases in training, with the subgradient of the current batch."""

    def __init__(self, types: PartTypes, shown: Sequence[Shown], rng: np.random.Generator) -> None:
        """Start with whitened means of the patches around the parts of the examples shown."""
        layers = int(types.tree.first[-1])
        size = FILTER * FILTER * shown[0].window.features.shape[2]
        sums, counts, background = np.zeros((layers, size)), np.zeros(layers), []
        for one in shown:
            around = _patches(one.window)
            background.append(around[rng.integers(0, ROWS, BACKGROUND), rng.integers(0, COLUMNS, BACKGROUND)])
            for layer, x, y in one.truth[one.seen]:
                sums[layer] += around[y, x].ravel()
                counts[layer] += 1
        behind = np.concatenate(background).reshape(-1, size)
        mean = behind.mean(axis=0)
        centred = behind - mean
        self.whiten = cho_factor(centred.T @ centred / len(centred) + RIDGE * np.eye(size))
        means = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None] - mean, 0.0)
        self.weights = (START * cho_solve(self.whiten, means.T).T).astype(np.float32)
        self.tree = types.tree
        self.bias = types.tree.bias.astype(np.float64).copy()
        self.bias[: types.tree.first[1], 0] -= self._typical(shown)
        self.sum_weights, self.sum_bias, self.averages = np.zeros(self.weights.shape), np.zeros(self.bias.shape), 0
        self._clear()

    def _typical(self, shown: Sequence[Shown]) -> float:
        """Median score of the true placements, less 2: the threshold to start with."""
        return float(np.median([self._score(one) for one in shown[:100]])) - 2.0

    def _score(self, one: Shown) -> float:
        return score_of(self._tree(), self._respond(one.window), one.truth)

    def _clear(self) -> None:
        self.gradient, self.bias_gradient = np.zeros(self.weights.shape, np.float32), np.zeros(self.bias.shape)

    def _tree(self) -> FilterTree:
        tree = self.tree
        return FilterTree(tree.parents, tree.first, tree.anchor, tree.spring, self.bias.astype(np.float32))

    def _respond(self, window: FeatureWindow) -> Array:
        return responses(window.features, self.weights.reshape(len(self.weights), FILTER, FILTER, -1))

    def compare(self, one: Shown) -> float:
        """Add the subgradient of one example; returns its augmented loss."""
        unary = self._respond(one.window)
        tree = self._tree()
        true_score = score_of(tree, unary, one.truth)
        augmented = unary + _losses(one, tree)
        wrong = best_placement(tree, pass_up(tree, augmented))
        # Parts that nobody saw have no truth to compare with.
        known = np.flatnonzero(one.seen)
        around = pad_window(one.window.features)
        self._add(around, one.truth, known, 1.0)
        self._add(around, wrong, known, -1.0)
        if true_score < 1:
            self._add(around, one.truth, known, 0.3)
        return score_of(tree, augmented, wrong) - true_score

    def push_down(self, window: FeatureWindow) -> None:
        """Add the subgradient of a window in which nobody is to be found."""
        unary = self._respond(window)
        tree = self._tree()
        found = best_placement(tree, pass_up(tree, unary))
        if score_of(tree, unary, found) > -1:
            self._add(pad_window(window.features), found, np.arange(len(found)), -0.3)

    def _add(self, around: Array, placement: Array, parts: Array, sign: float) -> None:
        """Add the features of some parts of a placement, times `sign`."""
        present = set(parts.tolist())
        for part in parts:
            layer, x, y = placement[part]
            self.gradient[layer] += np.float32(sign) * around[y : y + FILTER, x : x + FILTER].ravel()
            parent = PARENTS[part]
            if parent < 0:
                self.bias_gradient[layer, 0] += sign * BIAS_RATE
            elif parent in present:
                self.bias_gradient[layer, placement[parent, 0] - self.tree.first[parent]] += sign * TYPE_RATE

    def move(self, factor: float, average: bool) -> None:
        """Take one step along the gradient of the batch."""
        self.weights += (RATE * factor) * cho_solve(self.whiten, self.gradient.T).T.astype(np.float32)
        self.bias += RATE * factor * self.bias_gradient
        self._clear()
        if average:
            self.sum_weights += self.weights
            self.sum_bias += self.bias
            self.averages += 1

    def averaged(self) -> PartFilters:
        """The average model."""
        count = max(1, self.averages)
        weights, bias = self.sum_weights / count, self.sum_bias / count
        tree = self.tree
        filters = weights.astype(np.float32).reshape(len(weights), FILTER, FILTER, -1)
        return PartFilters(
            filters, FilterTree(tree.parents, tree.first, tree.anchor, tree.spring, bias.astype(np.float32))
        )


def _patches(window: FeatureWindow) -> Array:
    """All patches (ROWS, COLUMNS, 5, 5, D) that the filters see, a view of the padded features."""
    views = np.lib.stride_tricks.sliding_window_view(pad_window(window.features), (FILTER, FILTER), axis=(0, 1))
    return views.transpose(0, 1, 3, 4, 2)


def _losses(one: Shown, tree: FilterTree) -> Array:
    """What placing each layer in each cell (L, ROWS, COLUMNS) costs: up to 1, growing with the distance."""
    y, x = np.indices((ROWS, COLUMNS))
    losses = np.zeros((int(tree.first[-1]), ROWS, COLUMNS), np.float32)
    for part in np.flatnonzero(one.seen):
        distance = np.hypot(x - one.truth[part, 1], y - one.truth[part, 2])
        losses[tree.first[part] : tree.first[part + 1]] = np.minimum(1, distance / LOSS_CELLS)
    return losses
