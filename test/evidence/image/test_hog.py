# SPDX-License-Identifier: Apache-2.0
"""HOG features against the formula written out pixel by pixel, and what they must not depend on."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flowing_puppet_ros.evidence.image.hog import DIMENSIONS, OUTSIDE_INDEX, hog


def plain_hog(image: np.ndarray, cell: int) -> np.ndarray:
    """Section 6 of Felzenszwalb et al. without any table or shortcut."""
    height, width, channels = image.shape
    rows, columns = height // cell, width // cell
    votes = np.zeros((rows, columns, 18))
    pixels = image.astype(float)
    for y in range(1, min(rows * cell, height - 1)):
        for x in range(1, min(columns * cell, width - 1)):
            gradients = [
                (pixels[y, x + 1, c] - pixels[y, x - 1, c], pixels[y + 1, x, c] - pixels[y - 1, x, c])
                for c in range(channels)
            ]
            dx, dy = max(gradients, key=lambda g: math.hypot(*g))
            scores = [dx * math.cos(math.pi * o / 9) + dy * math.sin(math.pi * o / 9) for o in range(18)]
            bin_ = int(np.argmax(scores))
            for row in range(rows):
                for column in range(columns):
                    near_y = 1 - abs((y + 0.5) / cell - row - 0.5)
                    near_x = 1 - abs((x + 0.5) / cell - column - 0.5)
                    if near_y > 0 and near_x > 0:
                        votes[row, column, bin_] += near_y * near_x * math.hypot(dx, dy)
    unsigned = votes[..., :9] + votes[..., 9:]
    energy = np.pad((unsigned**2).sum(axis=2), 1, mode="edge")
    out = np.zeros((rows, columns, DIMENSIONS))
    for row in range(rows):
        for column in range(columns):
            for block, (a, b) in enumerate([(0, 0), (0, 1), (1, 0), (1, 1)]):
                norm = math.sqrt(energy[row + a : row + a + 2, column + b : column + b + 2].sum() + 1e-4)
                signed = np.minimum(votes[row, column] / norm, 0.2)
                out[row, column, :18] += signed / 2
                out[row, column, 18:27] += np.minimum(unsigned[row, column] / norm, 0.2) / 2
                out[row, column, 27 + block] = 0.2357 * signed.sum()
    return out


@pytest.mark.parametrize(("shape", "cell"), [((17, 22, 3), 5), ((12, 12, 1), 4), ((9, 30, 3), 8)])
def test_features_follow_the_formula(shape: tuple[int, int, int], cell: int) -> None:
    image = np.random.default_rng(sum(shape)).integers(0, 256, shape, dtype=np.uint8)
    np.testing.assert_allclose(hog(image, cell), plain_hog(image, cell), atol=2e-5)


def test_grey_in_two_or_three_dimensions_is_the_same() -> None:
    grey = np.random.default_rng(0).integers(0, 256, (20, 26), dtype=np.uint8)
    np.testing.assert_array_equal(hog(grey, 6), hog(np.repeat(grey[..., None], 3, axis=2), 6))


def test_contrast_hardly_matters_and_brightness_not_at_all() -> None:
    image = np.random.default_rng(1).integers(60, 120, (30, 30, 3), dtype=np.uint8)
    np.testing.assert_array_equal(hog(image + np.uint8(40), 6), hog(image, 6))
    np.testing.assert_allclose(hog(2 * image, 6), hog(image, 6), atol=1e-4)


def test_a_mirror_swaps_orientations() -> None:
    image = np.random.default_rng(2).integers(0, 256, (24, 24, 3), dtype=np.uint8)
    mirrored = hog(image[:, ::-1], 6)[:, ::-1]
    direct = hog(image, 6)
    np.testing.assert_allclose(mirrored[..., 27:].sum(axis=2), direct[..., 27:].sum(axis=2), atol=2e-2)
    np.testing.assert_allclose(mirrored[..., :18].sum(axis=2), direct[..., :18].sum(axis=2), atol=2e-2)


@pytest.mark.parametrize("shape", [(1, 1, 3), (5, 40, 3), (40, 5, 3)])
def test_images_smaller_than_a_cell_have_no_cells(shape: tuple[int, int, int]) -> None:
    assert hog(np.zeros(shape, np.uint8), 6).size == 0


def test_flat_images_have_no_gradients() -> None:
    features = hog(np.full((18, 18, 3), 77, np.uint8), 6)
    assert features.shape == (3, 3, DIMENSIONS)
    assert not features.any() and not features[..., OUTSIDE_INDEX].any()
