# SPDX-License-Identifier: Apache-2.0
"""Diverse selection against the plain greedy algorithm and against the best subset found by trying all."""

from collections.abc import Iterable
from itertools import combinations

import numpy as np
import pytest

from flowing_puppet_ros.inference.diverse import select_diverse


def coverage(weights: np.ndarray, chosen: Iterable[int]) -> float:
    return float(weights[:, list(chosen)].max(axis=1).sum())


def normalised(costs: np.ndarray, temperature: float) -> np.ndarray:
    return np.exp(-(costs - costs.min(axis=1, keepdims=True)) / temperature)


@pytest.mark.parametrize("seed", range(8))
def test_lazy_choice_equals_plain_greedy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    costs = rng.normal(size=(40, 25))
    weights = normalised(costs, 0.5)
    chosen = [3]
    while len(chosen) < 10:
        rest = [c for c in range(25) if c not in chosen]
        chosen.append(max(rest, key=lambda c: coverage(weights, [*chosen, c])))
    assert select_diverse(costs, 10, 3, 0.5).tolist() == chosen


@pytest.mark.parametrize("seed", range(8))
def test_close_to_the_best_subset(seed: int) -> None:
    rng = np.random.default_rng(seed)
    costs = rng.normal(size=(12, 9))
    weights = normalised(costs, 0.5)
    kept = int(costs.min(axis=0).argmin())
    chosen = select_diverse(costs, 4, kept, 0.5)
    best = max(coverage(weights, [kept, *rest]) for rest in combinations([c for c in range(9) if c != kept], 3))
    start = weights[:, kept].sum()
    assert coverage(weights, chosen) - start >= (1 - 1 / np.e) * (best - start) - 1e-12


def test_keeps_one_particle_of_every_mode_rather_than_many_of_the_best() -> None:
    costs = np.full((30, 20), 5.0)
    costs[:28, :18] = 0.0
    costs[28, 18] = 0.0
    costs[29, 19] = 0.0
    assert {0, 18, 19} == set(select_diverse(costs, 3, 0, 0.1).tolist())


def test_all_indices_are_different_and_all_can_be_chosen() -> None:
    costs = np.zeros((5, 7))
    assert sorted(select_diverse(costs, 7, 2, 0.1).tolist()) == list(range(7))
    with pytest.raises(ValueError, match="8 of 7"):
        select_diverse(costs, 8, 2, 0.1)
