# SPDX-License-Identifier: Apache-2.0
"""Robust affine fits against known motions, with outliers, unknown flow, few pixels and moving backgrounds."""

import numpy as np
import pytest
from numpy.typing import NDArray

from flowing_puppet_ros.flow.affine import MIN_TRANSLATION_SAMPLES, _fit, apply_affine, fit_regions

type Floats = NDArray[np.float64]

MOTION = np.array([[0.97, -0.12, 9.0], [0.15, 1.03, -4.0]])


def fit_affine(points: Floats, vectors: Floats) -> tuple[Floats, float, float]:
    """Motion (2, 3), residual in px and support of `vectors` (N, 2) at `points` (N, 2) that all weigh 1."""
    affine = np.empty((2, 3))
    residual, support = _fit(np.column_stack([points, vectors, np.ones((len(points), 2))]), affine)
    return affine, residual, support


def field_of(affine: Floats, height: int, width: int) -> Floats:
    """Displacements (H, W, 2) of a motion."""
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(float)
    return apply_affine(affine, grid.reshape(-1, 2)).reshape(height, width, 2) - grid


def test_recovers_the_motion_of_exact_flow() -> None:
    points = np.random.default_rng(1).uniform(0, 80, (500, 2))
    affine, residual, support = fit_affine(points, apply_affine(MOTION, points) - points)
    np.testing.assert_allclose(apply_affine(affine, points), apply_affine(MOTION, points), atol=0.02)
    assert residual < 0.02
    assert support == 1.0


def test_outliers_do_not_move_the_fit() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(0, 80, (1000, 2))
    vectors = apply_affine(MOTION, points) - points + rng.normal(0, 0.3, (1000, 2))
    vectors[:350] = rng.uniform(-40, 40, (350, 2))
    affine, _, support = fit_affine(points, vectors)
    assert np.abs(apply_affine(affine, points) - apply_affine(MOTION, points)).max() < 0.5
    assert 0.6 < support < 0.72
    plain = np.linalg.lstsq(np.column_stack([points, np.ones(1000)]), vectors, rcond=None)[0].T + np.eye(2, 3)
    assert np.abs(apply_affine(plain, points) - apply_affine(MOTION, points)).max() > 2.0


def test_a_shift_of_the_frame_shifts_the_motion() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(0, 60, (300, 2))
    vectors = apply_affine(MOTION, points) - points + rng.normal(0, 0.5, (300, 2))
    shift = np.array([1000.0, 500.0])
    here, _, _ = fit_affine(points, vectors)
    there, _, _ = fit_affine(points + shift, vectors)
    np.testing.assert_allclose(apply_affine(there, points + shift), apply_affine(here, points) + shift, atol=1e-6)


@pytest.mark.parametrize("count", [MIN_TRANSLATION_SAMPLES, 39])
def test_few_vectors_give_a_translation(count: int) -> None:
    points = np.random.default_rng(4).uniform(0, 9, (count, 2))
    affine, _, _ = fit_affine(points, np.tile([3.0, -2.0], (count, 1)))
    np.testing.assert_allclose(affine, [[1, 0, 3], [0, 1, -2]], atol=1e-9)


def test_fewer_vectors_give_no_motion() -> None:
    affine, residual, support = fit_affine(np.zeros((3, 2)), np.ones((3, 2)))
    np.testing.assert_array_equal(affine, np.eye(2, 3))
    assert residual == np.inf
    assert support == 0


def test_points_on_a_line_give_a_bounded_motion() -> None:
    points = np.column_stack([np.linspace(0, 50, 200), np.full(200, 7.0)])
    affine, _, _ = fit_affine(points, np.tile([2.0, 1.0], (200, 1)))
    np.testing.assert_allclose(affine, [[1, 0, 2], [0, 1, 1]], atol=1e-6)


def test_each_region_gets_its_own_motion_and_unknown_flow_is_left_out() -> None:
    labels = np.zeros((60, 80), np.uint8)
    labels[10:40, 10:30], labels[20:50, 45:70] = 1, 2
    other = np.array([[1.0, 0.05, -3.0], [-0.05, 1.0, 6.0]])
    forward = np.where((labels == 1)[..., None], field_of(MOTION, 60, 80), 0.0)
    forward = np.where((labels == 2)[..., None], field_of(other, 60, 80), forward).astype(np.float32)
    forward[12:30, 12:20] = np.nan
    motions = fit_regions(labels, 4, forward, None)
    np.testing.assert_allclose(motions.affine[0], np.eye(2, 3), atol=1e-6)
    for region, truth in ((1, MOTION), (2, other)):
        inside = np.argwhere(labels == region)[:, ::-1].astype(float)
        assert np.abs(apply_affine(motions.affine[region], inside) - apply_affine(truth, inside)).max() < 0.15
    assert motions.pixels.tolist() == [3450, 30 * 20 - 18 * 8, 30 * 25, 0]
    assert motions.known.tolist() == [True, True, True, False]


def test_a_limb_moves_although_its_outline_takes_in_still_background() -> None:
    labels = np.zeros((80, 80), np.uint8)
    labels[20:60, 20:60] = 1
    forward = np.zeros((80, 80, 2), np.float32)
    forward[20:60, 20:40] = (6, 0)
    motions = fit_regions(labels, 2, forward, None)
    moved = apply_affine(motions.affine[1], np.array([[25.0, 40.0]]))[0]
    np.testing.assert_allclose(moved, [31, 40], atol=0.5)


def test_vectors_that_do_not_return_count_less() -> None:
    labels = np.zeros((50, 50), np.uint8)
    labels[10:40, 10:40] = 1
    forward, backward = np.zeros((2, 50, 50, 2), np.float32)
    forward[10:40, 10:27], forward[10:40, 27:40] = (9, 0), (0, 5)
    backward[13:45, 10:40] = (0, -5)  # only the downward half agrees with the way back
    alone = fit_regions(labels, 2, forward, None).affine[1]
    checked = fit_regions(labels, 2, forward, backward).affine[1]
    centre = np.array([[33.0, 25.0]])
    assert np.linalg.norm(apply_affine(checked, centre) - centre - [0, 5]) < 1.0
    assert np.linalg.norm(apply_affine(alone, centre) - apply_affine(checked, centre)) > 0.01
