# SPDX-License-Identifier: Apache-2.0
"""Rotations against scipy's, round trips through 0 and pi, and Procrustes against perturbed answers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flowing_puppet_ros.model import rotation

AXES = np.random.default_rng(0).normal(size=(200, 3))
AXES = np.concatenate([AXES / np.linalg.norm(AXES, axis=1, keepdims=True), np.eye(3), -np.eye(3)])


def test_exp_agrees_with_scipy_in_any_batch_shape() -> None:
    vectors = np.random.default_rng(1).normal(size=(4, 5, 3)) * 2
    expected = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(4, 5, 3, 3)
    np.testing.assert_allclose(rotation.exp(vectors), expected, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-3, 1.0, 3.0, np.pi - 1e-4, np.pi - 1e-9])
def test_log_undoes_exp(angle: float) -> None:
    np.testing.assert_allclose(rotation.log(rotation.exp(angle * AXES)), angle * AXES, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-3, 1.0, 3.0, np.pi - 1e-4, np.pi - 1e-9])
def test_compiled_loops_have_the_same_exp_and_log(angle: float) -> None:
    for vector in angle * AXES:
        matrix = rotation.exp_one(vector)
        np.testing.assert_allclose(matrix, Rotation.from_rotvec(vector).as_matrix(), atol=1e-14)
        np.testing.assert_allclose(rotation.log_one(matrix), vector, atol=1e-9)


def test_half_turns_have_an_axis() -> None:
    turned = rotation.exp(np.pi * AXES)
    vectors = rotation.log(turned)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), np.pi)
    np.testing.assert_allclose(rotation.exp(vectors), turned, atol=1e-12)


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_exp_gives_rotations(vector: list[float]) -> None:
    matrix = rotation.exp(np.array(vector))
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(matrix), 1)


def test_procrustes_finds_what_moved_the_points() -> None:
    rng = np.random.default_rng(2)
    points = rng.normal(size=(6, 9, 3))
    turned, shift = rotation.exp(rng.normal(size=(6, 3))), rng.normal(size=(6, 3))
    found, moved = rotation.procrustes(points, points @ np.swapaxes(turned, 1, 2) + shift[:, None])
    np.testing.assert_allclose(found, turned, atol=1e-12)
    np.testing.assert_allclose(moved, shift, atol=1e-12)


def test_procrustes_is_the_weighted_least_squares_answer() -> None:
    rng = np.random.default_rng(3)
    a, b, w = rng.normal(size=(12, 3)), rng.normal(size=(12, 3)), rng.uniform(0.1, 2, size=12)
    found, shift = rotation.procrustes(a, b, w)

    def cost(turned: np.ndarray, moved: np.ndarray) -> float:
        return float(w @ ((a @ turned.T + moved - b) ** 2).sum(axis=1))

    assert np.linalg.det(found) == pytest.approx(1)
    best = cost(found, shift)
    for _ in range(200):
        assert cost(rotation.exp(rng.normal(size=3) * 0.05) @ found, shift + rng.normal(size=3) * 0.02) > best


def test_procrustes_never_mirrors() -> None:
    points = np.random.default_rng(4).normal(size=(10, 3))
    found, _ = rotation.procrustes(points, points * [1, -1, 1])
    assert np.linalg.det(found) == pytest.approx(1)


def test_points_without_weight_do_not_count() -> None:
    rng = np.random.default_rng(5)
    points, turned = rng.normal(size=(8, 3)), rotation.exp(np.array([0.4, -1.0, 2.0]))
    target = points @ turned.T
    target[0] += 100
    found, shift = rotation.procrustes(points, target, np.array([0.0] + [1.0] * 7))
    np.testing.assert_allclose(found, turned, atol=1e-12)
    np.testing.assert_allclose(shift, 0, atol=1e-12)
