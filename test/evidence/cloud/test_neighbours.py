# SPDX-License-Identifier: Apache-2.0
"""Neighbours of a cloud's points against a k-d tree, and normals against NumPy's eigenvectors."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from flowing_puppet_ros.evidence.cloud.neighbours import find_neighbours, fit_normals

RNG = np.random.default_rng(0)
SPHERE = RNG.normal(size=(2000, 3))
SPHERE /= np.linalg.norm(SPHERE, axis=1, keepdims=True)
LINE = np.outer(RNG.random(300), [1.0, 2.0, 3.0])


@pytest.mark.parametrize("count", [1, 6, 24])
@pytest.mark.parametrize(
    "points",
    [
        SPHERE,
        RNG.random((700, 3)),
        SPHERE * [1, 1, 0],
        LINE,
        SPHERE[:8],
        np.repeat(SPHERE[:40], 30, axis=0),
        np.vstack([SPHERE, [[1e4, 0, 0]]]),
        np.vstack([0.01 * SPHERE, SPHERE[:200] + 3]),
    ],
)
def test_the_neighbours_are_the_nearest_points(points: np.ndarray, count: int) -> None:
    found = find_neighbours(points, count)
    count = min(count, len(points))
    assert found.shape == (len(points), count)
    assert (np.diff(np.sort(found, axis=1), axis=1) > 0).all(), "no point twice"
    distance = np.sort(np.linalg.norm(points[found] - points[:, None], axis=2), axis=1)
    expected = cKDTree(points).query(points, k=count)[0].reshape(len(points), count)
    np.testing.assert_array_equal(np.sort(find_neighbours(points[: len(points)], count, 3)), np.sort(found[::3]))
    np.testing.assert_allclose(distance, expected, atol=1e-12)


def test_normals_are_the_directions_of_least_spread() -> None:
    for points in (SPHERE, RNG.random((500, 3)), SPHERE * [1, 1, 0], 1e-3 * SPHERE):
        near = find_neighbours(points, 12)
        normals = fit_normals(points, near)
        gap = points[near] - points[near].mean(axis=1, keepdims=True)
        covariance = gap.transpose(0, 2, 1) @ gap
        least = np.linalg.eigvalsh(covariance)[:, 0]
        spread = np.einsum("ni,nij,nj->n", normals, covariance, normals)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
        np.testing.assert_allclose(spread, least, atol=1e-9 * np.trace(covariance, axis1=1, axis2=2).max())


def test_points_on_a_line_or_in_one_place_have_some_normal() -> None:
    normals = fit_normals(LINE, find_neighbours(LINE, 9))
    np.testing.assert_allclose(normals @ [1.0, 2.0, 3.0], 0.0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    same = np.ones((20, 3))
    np.testing.assert_allclose(fit_normals(same, find_neighbours(same, 9)), np.tile([0.0, 0.0, 1.0], (20, 1)))
