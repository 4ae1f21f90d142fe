# SPDX-License-Identifier: Apache-2.0
"""Max-product belief propagation over a tree whose nodes hold particles (thesis Eqs. 16, 17 and 19).

Potentials are given as costs, the negative logarithm of the thesis's potentials, so that products become sums and the
maximum becomes a minimum. Nothing underflows, and a tree needs one sweep up and one sweep down.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.model.tree import PartTree


@dataclass(frozen=True, slots=True, eq=False)
class MaxProduct:
    """Result of one run of max-product; edge e of the tree leads from `tree.edges[e][0]` to node e + 1.

    Attributes:
        to_parent: per edge the message from child to parent, one cost a particle of the parent.
        to_child: per edge the message from parent to child, one cost a particle of the child.
        marginals: per node the lowest total cost of any configuration that uses the particle (negative logarithm of
            the max-marginal, Eq. 17 with the node's own potential).
        assignment: (nodes,) int64, the particle of every node in the best configuration, found by back-tracking.
        cost: total cost of that configuration.
    """

    to_parent: tuple[np.ndarray, ...]
    to_child: tuple[np.ndarray, ...]
    marginals: tuple[np.ndarray, ...]
    assignment: np.ndarray
    cost: float


def max_product(tree: PartTree, node_costs: Sequence[np.ndarray], edge_costs: Sequence[np.ndarray]) -> MaxProduct:
    """Run max-product to its exact end on a tree (Eqs. 16, 17 and 19).

    Args:
        tree: the graph; nodes may have different numbers of particles.
        node_costs: per node (particles,) finite costs.
        edge_costs: per edge (particles of the parent, particles of the child) finite costs.

    Raises:
        ValueError: if shapes do not agree with the tree.
    """
    _check(tree, node_costs, edge_costs)
    beliefs = [np.array(cost, dtype=np.float64) for cost in node_costs]
    to_parent: list[np.ndarray] = [np.empty(0)] * len(tree.edges)
    best_child: list[np.ndarray] = [np.empty(0, dtype=np.int64)] * len(tree.edges)
    for parent, child in reversed(tree.edges):
        through = edge_costs[child - 1] + beliefs[child]
        best_child[child - 1] = through.argmin(axis=1)
        to_parent[child - 1] = through.min(axis=1)
        beliefs[parent] += to_parent[child - 1]

    assignment = np.zeros(len(tree), dtype=np.int64)
    assignment[0] = beliefs[0].argmin()
    cost = float(beliefs[0].min())
    to_child: list[np.ndarray] = []
    for parent, child in tree.edges:
        assignment[child] = best_child[child - 1][assignment[parent]]
        others = beliefs[parent] - to_parent[child - 1]
        to_child.append((edge_costs[child - 1] + others[:, None]).min(axis=0))
        beliefs[child] += to_child[-1]
    return MaxProduct(tuple(to_parent), tuple(to_child), tuple(beliefs), assignment, cost)


def message_foundation(tree: PartTree, edge_costs: Sequence[np.ndarray], result: MaxProduct, node: int) -> np.ndarray:
    """Return the matrix whose row minima are all messages that leave a node.

    Row b belongs to one particle of one neighbour, column a to one particle of `node`; the entry is the edge's cost
    plus everything else that `node` knows about a. A subset of columns keeps the messages as far as it keeps the row
    minima ("message foundation matrix" of Pacheco, Zuffi, Black and Sudderth, Preserving Modes and Messages via
    Diverse Particle Selection, ICML 2014).

    Args:
        tree: the graph.
        edge_costs: as given to `max_product`.
        result: what `max_product` returned for them.
        node: the node whose particles are the columns.

    Returns:
        (sum of the neighbours' particles, particles of `node`) costs.
    """
    rows = []
    parent = tree.parents[node]
    if parent >= 0:
        rows.append(edge_costs[node - 1] + (result.marginals[node] - result.to_child[node - 1]))
    for child in tree.children(node):
        rows.append(edge_costs[child - 1].T + (result.marginals[node] - result.to_parent[child - 1]))
    return np.concatenate(rows) if rows else result.marginals[node][None, :]


def _check(tree: PartTree, node_costs: Sequence[np.ndarray], edge_costs: Sequence[np.ndarray]) -> None:
    if len(node_costs) != len(tree) or len(edge_costs) != len(tree.edges):
        raise ValueError(
            f"a tree of {len(tree)} nodes needs {len(tree)} node costs and {len(tree.edges)} edge costs,"
            f" got {len(node_costs)} and {len(edge_costs)}"
        )
    for parent, child in tree.edges:
        wanted = (len(node_costs[parent]), len(node_costs[child]))
        if np.shape(edge_costs[child - 1]) != wanted:
            raise ValueError(
                f"the costs of the edge to node {child} are {np.shape(edge_costs[child - 1])}, not {wanted}"
            )
