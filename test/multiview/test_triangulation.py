# SPDX-License-Identifier: Apache-2.0
"""Triangulation: exact points, noise, wrong and missing views."""

from collections.abc import Callable

import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.triangulation import TriangulationSettings, triangulate

Ring = Callable[..., list[Camera]]
LENS = (-0.05, 0.1, 0.001, -0.001, 0.0)


def views(cameras: list[Camera], points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.stack([camera.project(points)[0] for camera in cameras]), np.full((len(cameras), len(points)), 0.8)


def body(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform((-0.4, -0.6, -0.7), (0.4, 0.6, 0.7), (30, 3))


@pytest.mark.parametrize("count", [2, 3, 4, 8])
def test_exact_views_give_the_exact_points(ring: Ring, count: int) -> None:
    cameras = ring(5, lens=LENS)[:2] if count == 2 else ring(count, lens=LENS)
    pixels, weights = views(cameras, body())
    points, confidence = triangulate(cameras, pixels, weights)
    np.testing.assert_allclose(points, body(), atol=1e-7)
    np.testing.assert_allclose(confidence, 0.8)


def test_noise_is_averaged_over_the_views(ring: Ring) -> None:
    rng = np.random.default_rng(2)
    error = {}
    for count in (3, 8):
        cameras = ring(count)
        pixels, weights = views(cameras, body())
        points, _ = triangulate(cameras, pixels + rng.normal(size=pixels.shape), weights)
        error[count] = np.sqrt(np.mean((points - body()) ** 2))
    # One pixel is one centimetre here; n good views give about 1 / sqrt(n / 2) of it.
    assert error[8] < 0.75 * error[3] < 0.01


def test_one_wrong_camera_a_joint_is_left_out(ring: Ring) -> None:
    rng = np.random.default_rng(3)
    cameras = ring(4)
    pixels, weights = views(cameras, body())
    wrong = rng.integers(0, 4, 30)
    angle = rng.uniform(0, 2 * np.pi, 30)
    pixels[wrong, np.arange(30)] += 60 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points, confidence = triangulate(cameras, pixels, weights)
    np.testing.assert_allclose(points, body(), atol=2e-3)
    np.testing.assert_allclose(confidence, 0.8 * 0.75)


def test_weak_views_pull_less(ring: Ring) -> None:
    cameras = ring(4)
    pixels, weights = views(cameras, body())
    pixels[0, :, 0] += 2
    strong, _ = triangulate(cameras, pixels, weights)
    weights[0] = 0.15
    weak, _ = triangulate(cameras, pixels, weights)
    assert np.linalg.norm(weak - body()) < 0.5 * np.linalg.norm(strong - body())


def test_missing_views_are_skipped_and_one_view_is_not_enough(ring: Ring) -> None:
    cameras = ring(4)
    pixels, weights = views(cameras, body()[:4])
    pixels[:3, 0] = np.nan  # only one view left
    weights[:2, 1] = 0  # two views left
    weights[2, 2] = np.nan
    points, confidence = triangulate(cameras, pixels, weights)
    assert np.isnan(points[0]).all() and confidence[0] == 0
    np.testing.assert_allclose(points[1:], body()[1:4], atol=1e-7)
    np.testing.assert_allclose(confidence[1:], 0.8)


def test_two_views_that_contradict_place_nothing(ring: Ring) -> None:
    cameras = ring(5)[:2]
    pixels, weights = views(cameras, body())
    pixels[0, :, 1] += 50
    points, confidence = triangulate(cameras, pixels, weights)
    assert np.isnan(points).all() and (confidence == 0).all()


def test_two_views_from_one_place_place_nothing(ring: Ring) -> None:
    camera = ring(4)[0]
    pixels, weights = views([camera, camera], body())
    assert np.isnan(triangulate([camera, camera], pixels, weights)[0]).all()


def test_unconfident_detections_are_left_out(ring: Ring) -> None:
    cameras = ring(4)
    pixels, weights = views(cameras, body())
    pixels[0] += 3
    weights[0] = 0.05
    points, _ = triangulate(cameras, pixels, weights, TriangulationSettings(min_confidence=0.1))
    np.testing.assert_allclose(points, body(), atol=1e-7)


def test_shapes_that_do_not_fit_are_refused(ring: Ring) -> None:
    with pytest.raises(InputError, match="at least 2 cameras, got 1"):
        triangulate(ring(1), np.zeros((1, 3, 2)), np.ones((1, 3)))
    with pytest.raises(InputError, match=r"\(3, J, 2\)"):
        triangulate(ring(3), np.zeros((2, 3, 2)), np.ones((2, 3)))
