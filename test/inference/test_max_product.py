# SPDX-License-Identifier: Apache-2.0
"""Max-product against exhaustive search over all configurations of small trees."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowing_puppet_ros.inference.max_product import max_product, message_foundation
from flowing_puppet_ros.model.tree import PartTree

Costs = list[np.ndarray]
Problem = tuple[PartTree, Costs, Costs]


def random_problem(seed: int) -> Problem:
    rng = np.random.default_rng(seed)
    nodes = int(rng.integers(1, 6))
    parents = (-1, *(int(rng.integers(0, child)) for child in range(1, nodes)))
    tree = PartTree(tuple(f"n{i}" for i in range(nodes)), parents)
    sizes = rng.integers(1, 5, nodes)
    node_costs = [rng.normal(size=size) for size in sizes]
    edge_costs = [rng.normal(size=(sizes[parent], sizes[child])) * 2 for parent, child in tree.edges]
    return tree, node_costs, edge_costs


def exhaustive(tree: PartTree, node_costs: Costs, edge_costs: Costs) -> dict[tuple[int, ...], float]:
    """Total cost of every configuration, as {assignment: cost}."""
    costs = {}
    for pick in product(*(range(len(cost)) for cost in node_costs)):
        total = sum(cost[p] for cost, p in zip(node_costs, pick, strict=True))
        total += sum(edge_costs[child - 1][pick[parent], pick[child]] for parent, child in tree.edges)
        costs[pick] = total
    return costs


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6))
def test_equals_exhaustive_search(seed: int) -> None:
    tree, node_costs, edge_costs = random_problem(seed)
    result = max_product(tree, node_costs, edge_costs)
    costs = exhaustive(tree, node_costs, edge_costs)
    best = min(costs, key=lambda pick: costs[pick])
    assert tuple(result.assignment) == best
    assert result.cost == pytest.approx(costs[best])
    for node, marginal in enumerate(result.marginals):
        for particle, value in enumerate(marginal):
            assert value == pytest.approx(min(c for pick, c in costs.items() if pick[node] == particle))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6))
def test_foundation_row_minima_are_the_outgoing_messages(seed: int) -> None:
    tree, node_costs, edge_costs = random_problem(seed)
    result = max_product(tree, node_costs, edge_costs)
    for node in range(len(tree)):
        sent = [result.to_parent[node - 1]] if node else []
        sent += [result.to_child[child - 1] for child in tree.children(node)]
        rows = message_foundation(tree, edge_costs, result, node)
        if sent:
            np.testing.assert_allclose(rows.min(axis=1), np.concatenate(sent), atol=1e-12)


def test_dropping_particles_outside_the_best_configuration_keeps_its_cost() -> None:
    tree, node_costs, edge_costs = random_problem(4)
    result = max_product(tree, node_costs, edge_costs)
    pick = result.assignment
    alone = max_product(
        tree,
        [cost[[p]] for cost, p in zip(node_costs, pick, strict=True)],
        [edge_costs[child - 1][[pick[parent]]][:, [pick[child]]] for parent, child in tree.edges],
    )
    assert alone.cost == pytest.approx(result.cost)


def test_mismatched_shapes_are_refused() -> None:
    tree = PartTree(("a", "b"), (-1, 0))
    with pytest.raises(ValueError, match="edge to node 1"):
        max_product(tree, [np.zeros(2), np.zeros(3)], [np.zeros((3, 2))])
    with pytest.raises(ValueError, match="2 nodes"):
        max_product(tree, [np.zeros(2)], [np.zeros((2, 2))])
