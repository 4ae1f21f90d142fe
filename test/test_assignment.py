# SPDX-License-Identifier: Apache-2.0
"""The cheapest assignment, compared with SciPy's and with a case done by hand."""

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from flowing_puppet_ros.assignment import assign_cheapest


def test_taking_the_cheapest_first_is_not_the_cheapest_in_all() -> None:
    rows, columns = assign_cheapest(np.array([[1.0, 2.0], [2.0, 9.0]]))
    assert rows.tolist() == [0, 1] and columns.tolist() == [1, 0]


@pytest.mark.parametrize("shape", [(1, 1), (3, 3), (2, 5), (6, 3), (8, 8), (0, 4), (4, 0)])
def test_as_cheap_as_scipys(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        cost = rng.normal(size=shape)
        rows, columns = assign_cheapest(cost)
        expected = linear_sum_assignment(cost)
        np.testing.assert_array_equal(rows, expected[0])
        np.testing.assert_array_equal(columns, expected[1])


def test_ties_cost_no_more_than_scipys() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        cost = np.minimum(rng.random((4, 6)), 0.3)
        found = assign_cheapest(cost)
        assert cost[found].sum() == pytest.approx(cost[linear_sum_assignment(cost)].sum())
        assert len(set(found[1].tolist())) == 4


def test_infinite_costs_are_refused() -> None:
    with pytest.raises(ValueError, match="finite"):
        assign_cheapest(np.array([[np.inf, 1.0]]))
