# SPDX-License-Identifier: Apache-2.0
"""Noise of depth images of a cylinder as thick as a trunk, far away and near."""

import numpy as np
import pytest

from flowing_puppet_ros.evidence.cloud.depth_smoothing import smooth_depth
from flowing_puppet_ros.evidence.cloud.range_image import RangeImage
from flowing_puppet_ros.evidence.cloud.sensor_field import SensorProjection

WIDTH, HEIGHT, FOCAL, RADIUS_M, WALL_M = 160, 120, 260.0, 0.15, 9.0
LENS = SensorProjection.pinhole(FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)


def look(distance: float, noise: float) -> tuple[RangeImage, np.ndarray, np.ndarray, np.ndarray]:
    """Return the image of a cylinder before a wall, its points and true points (N, 3), and which are the cylinder's."""
    right, down = np.meshgrid((np.arange(WIDTH) - (WIDTH - 1) / 2) / FOCAL, (np.arange(HEIGHT) - 59.5) / FOCAL)
    inside = np.sqrt(np.maximum(RADIUS_M**2 - (right * distance) ** 2, 0))
    own = np.abs(right * distance) < 0.95 * RADIUS_M
    true = np.where(own, distance - inside, WALL_M)
    sensed = true + noise * np.random.default_rng(0).standard_normal(true.shape)
    clouds = [np.stack([right * z, down * z, z], axis=-1).reshape(-1, 3) for z in (sensed, true)]
    image = RangeImage.of_camera(LENS, clouds[0], np.arange(WIDTH * HEIGHT), (HEIGHT, WIDTH))
    return image, clouds[0], clouds[1], own.ravel()


@pytest.mark.parametrize(("distance", "noise"), [(6.0, 0.08), (3.5, 0.02), (2.0, 0.01)])
def test_noise_is_averaged_along_the_rays(distance: float, noise: float) -> None:
    image, points, true, own = look(distance, noise)
    smooth = smooth_depth(image, points, own)
    np.testing.assert_allclose(smooth[:, :2] / smooth[:, 2:], points[own, :2] / points[own, 2:], atol=1e-9)
    before, after = (np.abs(cloud[:, 2] - true[own, 2]) for cloud in (points[own], smooth))
    assert after.mean() < 0.5 * before.mean()


def test_points_with_little_noise_and_those_of_no_depth_image_stay() -> None:
    image, points, _, own = look(2.5, 0.005)
    np.testing.assert_array_equal(smooth_depth(image, points, own), points[own])
    noisy = look(6.0, 0.08)[1]
    scan = RangeImage.of_scan(noisy, np.zeros(3))
    np.testing.assert_array_equal(smooth_depth(scan, noisy, own), noisy[own])
