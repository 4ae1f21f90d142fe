# SPDX-License-Identifier: Apache-2.0
"""Distance transforms and max-product on part trees, against brute force over all placements."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowing_puppet_ros.image.detector.pictorial_structure import (
    FilterTree,
    distance_transform,
    find_best_placement,
    pass_down,
    pass_up,
    score_placement,
)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), height=st.integers(1, 9), width=st.integers(1, 9))
def test_transform_is_the_maximum_over_all_cells(seed: int, height: int, width: int) -> None:
    rng = np.random.default_rng(seed)
    scores = rng.normal(0, 3, (height, width)).astype(np.float32)
    anchor = rng.uniform(-4, 4, 2).astype(np.float32)
    spring = rng.uniform(0.01, 2, 2).astype(np.float32)
    out = np.empty_like(scores)
    distance_transform(scores, anchor, spring, out)
    v, u = np.indices(scores.shape)
    for y, x in np.ndindex(scores.shape):
        cost = spring[0] * (u - x - anchor[0]) ** 2 + spring[1] * (v - y - anchor[1]) ** 2
        assert out[y, x] == pytest.approx((scores - cost).max(), abs=2e-4)


def random_tree(rng: np.random.Generator) -> tuple[FilterTree, np.ndarray]:
    """A root of two types, a chain of two and a leaf, on a grid of 3 x 2; and the layers' scores."""
    first = np.array([0, 2, 4, 5, 7])
    layers = int(first[-1])
    tree = FilterTree(
        np.array([-1, 0, 1, 0]),
        first,
        rng.uniform(-1.5, 1.5, (layers, 2)).astype(np.float32),
        rng.uniform(0.05, 1, (layers, 2)).astype(np.float32),
        rng.normal(size=(layers, 2)).astype(np.float32),
    )
    return tree, rng.normal(0, 2, (layers, 2, 3)).astype(np.float32)


def all_placements(tree: FilterTree) -> list[np.ndarray]:
    states = [
        [(layer, x, y) for layer in range(tree.first[p], tree.first[p + 1]) for x in range(3) for y in range(2)]
        for p in range(len(tree.parents))
    ]
    return [np.array(rows) for rows in itertools.product(*states)]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_best_placement_and_marginals_agree_with_brute_force(seed: int) -> None:
    tree, unary = random_tree(np.random.default_rng(seed))
    placements = all_placements(tree)
    scores = np.array([score_placement(tree, unary, placement) for placement in placements])
    beliefs = pass_down(tree, pass_up(tree, unary))
    best = find_best_placement(tree, beliefs)
    assert score_placement(tree, unary, best) == pytest.approx(scores.max(), abs=1e-4)
    assert beliefs.down is not None
    marginals = beliefs.up + beliefs.down
    for part in range(4):
        for layer, y, x in [(int(tree.first[part]), 1, 2), (int(tree.first[part + 1]) - 1, 0, 0)]:
            fits = [i for i, placement in enumerate(placements) if tuple(placement[part]) == (layer, x, y)]
            assert marginals[layer, y, x] == pytest.approx(scores[fits].max(), abs=1e-4)
            fixed = find_best_placement(tree, beliefs, (part, layer, x, y))
            assert tuple(fixed[part]) == (layer, x, y)
            assert score_placement(tree, unary, fixed) == pytest.approx(scores[fits].max(), abs=1e-4)
