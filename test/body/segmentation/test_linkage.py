# SPDX-License-Identifier: Apache-2.0
"""Single linkage gives the connected components of the graph of near points, by an independent search."""

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from flowing_puppet_ros.body.segmentation.linkage import link_within


@pytest.mark.parametrize(("count", "gap"), [(1, 0.1), (2, 0.1), (300, 0.2), (4000, 0.12), (4000, 0.25)])
def test_clusters_are_the_components_of_near_points_numbered_by_their_first(count: int, gap: float) -> None:
    points = np.random.default_rng(count).uniform(-3, 3, (count, 3)) * [1, 1, 0.4] + [100, -50, 0]
    pairs = cKDTree(points).query_pairs(gap, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(count, count))
    label = link_within(points, gap)
    np.testing.assert_array_equal(label, connected_components(graph, directed=False)[1])
    first = np.unique(label, return_index=True)[1]
    assert (np.diff(first) > 0).all()


def test_no_points_make_no_cluster() -> None:
    assert link_within(np.empty((0, 3)), 0.1).shape == (0,)
