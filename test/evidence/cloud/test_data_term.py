# SPDX-License-Identifier: Apache-2.0
"""The voxel grid and the data term against brute force."""

import numpy as np
import pytest

from flowing_puppet_ros.evidence.cloud.data_term import CloudGrid, ExactCloud, look_up
from flowing_puppet_ros.evidence.cloud.nearest import NearestPoints

CENTRE = np.array([1.0, 2.0, -0.5])


@pytest.fixture(scope="module")
def sphere() -> CloudGrid:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(3000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return CloudGrid.build(0.3 * normals + CENTRE, normals)


def closest(grid: CloudGrid, queries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    index = np.array([look_up(grid.nearest, grid.origin, grid.cell, *query) for query in queries])
    return index, np.linalg.norm(queries - grid.points[index], axis=1)


def test_closest_is_within_a_cell_of_brute_force(sphere: CloudGrid) -> None:
    queries = np.random.default_rng(1).uniform(-0.5, 0.5, (500, 3)) + CENTRE
    index, distance = closest(sphere, queries)
    exact = np.linalg.norm(queries[:, None] - sphere.points, axis=2)
    np.testing.assert_allclose(distance, exact[np.arange(500), index])
    slack = np.sqrt(3) * sphere.cell
    assert np.all(distance <= exact.min(axis=1) + slack)
    assert np.mean(distance - exact.min(axis=1)) < 0.1 * sphere.cell


@pytest.mark.slow
def test_cells_hold_nearly_the_nearest_point(sphere: CloudGrid) -> None:
    rng = np.random.default_rng(4)
    cells = rng.integers(0, sphere.nearest.shape, (2000, 3))
    centres = sphere.origin + sphere.cell * cells
    taken = np.linalg.norm(centres - sphere.points[sphere.nearest[tuple(cells.T)]], axis=1)
    exact = np.linalg.norm(centres[:, None] - sphere.points, axis=2).min(axis=1)
    near = exact < 0.1
    assert np.all(taken >= exact - 1e-12) and np.all(taken[near] < exact[near] + 0.3 * sphere.cell)
    assert (taken - exact).max() < 1.5 * sphere.cell
    assert np.mean(taken - exact) < 0.03 * sphere.cell


def test_far_queries_are_answered_at_the_border(sphere: CloudGrid) -> None:
    index, distance = closest(sphere, np.array([[100.0, 2.0, -0.5], [-100.0, 2.0, -0.5]]))
    assert sphere.points[index[0], 0] > 1.25
    assert sphere.points[index[1], 0] < 0.75
    assert distance[0] == pytest.approx(98.7, abs=0.05)


def test_data_cost_equals_the_formula(sphere: CloudGrid) -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-0.4, 0.4, (4, 50, 3)) + CENTRE
    normals = rng.normal(size=(4, 50, 3))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    cost, mismatch = sphere.data_cost(points, normals)
    index, distance = closest(sphere, points.reshape(-1, 3))
    index, distance = index.reshape(4, 50), distance.reshape(4, 50)
    np.testing.assert_allclose(cost, ((distance**2 + 0.001) ** 0.45).mean(axis=1))
    angle = np.arccos(np.clip((normals * sphere.normals[index]).sum(axis=2), -1, 1))
    np.testing.assert_allclose(mismatch, (angle > 0.75 * np.pi).mean(axis=1))


def test_inside_out_surface_pays_for_its_normals_only(sphere: CloudGrid) -> None:
    points, normals = sphere.points[None, :200], sphere.normals[None, :200]
    right, wrong = sphere.data_cost(points, normals), sphere.data_cost(points, -normals)
    assert right[0] == wrong[0]
    assert right[1] == 0.0
    assert wrong[1] == 1.0


def test_wide_clouds_get_larger_cells() -> None:
    points = np.array([[0.0, 0.0, 0.0], [100.0, 100.0, 100.0]])
    grid = CloudGrid.build(points, np.eye(3)[:2])
    assert grid.nearest.size < 3_000_000
    assert closest(grid, points)[0].tolist() == [0, 1]


def test_the_exact_cloud_takes_the_nearest_of_all_points(sphere: CloudGrid) -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-0.4, 0.4, (3, 40, 3)) + CENTRE
    normals = rng.normal(size=(3, 40, 3))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    cost, mismatch = ExactCloud(sphere.points, sphere.normals, NearestPoints(sphere.points)).data_cost(points, normals)
    gaps = np.linalg.norm(points[:, :, None] - sphere.points, axis=3)
    np.testing.assert_allclose(cost, ((gaps.min(axis=2) ** 2 + 0.001) ** 0.45).mean(axis=1))
    angle = np.arccos(np.clip((normals * sphere.normals[gaps.argmin(axis=2)]).sum(axis=2), -1, 1))
    np.testing.assert_allclose(mismatch, (angle > 0.75 * np.pi).mean(axis=1))
