# SPDX-License-Identifier: Apache-2.0
"""The grid of nearest points against a k-d tree."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from flowing_puppet_ros.evidence.cloud.nearest import NearestPoints

RNG = np.random.default_rng(0)
SPHERE = RNG.normal(size=(2000, 3))
SPHERE /= np.linalg.norm(SPHERE, axis=1, keepdims=True)


@pytest.mark.parametrize(
    ("points", "queries"),
    [
        (SPHERE, 1.02 * SPHERE[::3]),
        (SPHERE, RNG.normal(size=(500, 3))),
        (SPHERE, SPHERE[:200] + 50.0),
        (SPHERE * [1, 1, 0], SPHERE),
        (SPHERE * [1, 0, 0], SPHERE),
        (np.zeros((3, 3)), SPHERE[:10]),
        (SPHERE[:1], SPHERE[:10]),
        (np.vstack([SPHERE[:50], [[1e6, 0, 0]]]), np.vstack([SPHERE[:50], [[1e6, 1, 0]]])),
    ],
)
def test_near_and_far_the_answer_is_exact(points: np.ndarray, queries: np.ndarray) -> None:
    distance, index = NearestPoints(points).query(queries)
    np.testing.assert_allclose(distance, cKDTree(points).query(queries)[0], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(points[index] - queries, axis=1), distance, atol=1e-12)


def test_directions_count_as_lengths() -> None:
    """Two sheets a centimetre apart that face opposite ways: the nearer one is not the one that agrees."""
    level = np.random.default_rng(1).random((400, 2))
    points = np.vstack([np.c_[level, np.zeros(400)], np.c_[level, np.full(400, 0.01)]])
    normals = np.repeat([[0, 0, -1.0], [0, 0, 1.0]], 400, axis=0)
    queries, looks = np.c_[level[:50], np.full(50, 0.002)], np.tile([0, 0, 1.0], (50, 1))
    distance, index = NearestPoints(points, normals, 0.03).query(queries, looks)
    assert (index >= 400).all()
    tree = cKDTree(np.hstack([points, 0.03 * normals]))
    np.testing.assert_allclose(distance, tree.query(np.hstack([queries, 0.03 * looks]))[0])


def test_a_guess_changes_the_time_and_not_the_answer() -> None:
    rng = np.random.default_rng(2)
    queries, wild = SPHERE[::2] + 0.05 * rng.normal(size=(1000, 3)), rng.integers(0, len(SPHERE), 1000)
    for index, directions in ((NearestPoints(SPHERE), None), (NearestPoints(SPHERE, SPHERE, 0.03), SPHERE[::2])):
        plain = index.query(queries, directions)
        for guess in (wild, plain[1]):
            distance, found = index.query(queries, directions, guess)
            np.testing.assert_array_equal(found, plain[1])
            np.testing.assert_allclose(distance, plain[0], atol=1e-12)
