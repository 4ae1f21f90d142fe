# SPDX-License-Identifier: Apache-2.0
"""Distances to masks against brute force, and their bits under changing memory."""

import numpy as np

from flowing_puppet_ros.multiview.distance_transform import MAX_DISTANCE_PX, distance_transform, signed_distance


def test_distance_is_the_nearest_pixels() -> None:
    rng = np.random.default_rng(0)
    for share in (0.01, 0.3, 0.9):
        mask = rng.random((23, 31)) < share
        pixels, filled = np.argwhere(np.ones_like(mask)), np.argwhere(mask)
        expected = np.linalg.norm(pixels[:, None] - filled[None], axis=2).min(axis=1).reshape(mask.shape)
        np.testing.assert_allclose(distance_transform(mask), expected, rtol=1e-15)


def test_without_a_mask_everything_is_far() -> None:
    assert (distance_transform(np.zeros((4, 5), bool)) == MAX_DISTANCE_PX).all()
    assert (signed_distance(np.zeros((4, 5), np.uint8)) == MAX_DISTANCE_PX - 0.5).all()
    assert (signed_distance(np.ones((4, 5), np.uint8)) == 0.5 - MAX_DISTANCE_PX).all()


def test_the_sign_changes_half_a_pixel_outside_the_mask() -> None:
    mask = np.zeros((5, 7), np.uint8)
    mask[:, :3] = 255
    np.testing.assert_allclose(signed_distance(mask)[2], [-2.5, -1.5, -0.5, 0.5, 1.5, 2.5, 3.5])


def test_bits_do_not_depend_on_where_the_memory_lies() -> None:
    rng = np.random.default_rng(1)
    mask = rng.random((270, 151)) < 0.001
    bits, kept = set(), []
    for size in rng.integers(1, 100_000, 25):
        kept.append(np.empty(size, np.uint8))
        bits.add(distance_transform(mask.copy()).tobytes())
    assert len(bits) == 1
