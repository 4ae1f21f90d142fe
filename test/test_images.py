# SPDX-License-Identifier: Apache-2.0
"""What is taken for an image, and the one sentence for everything else."""

from __future__ import annotations

import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.images import as_image, as_rgb, reduce_image


@pytest.mark.parametrize("shape", [(1, 1), (5, 7), (5, 7, 3)])
def test_images_are_themselves(shape: tuple[int, ...]) -> None:
    image = np.zeros(shape, np.uint8)
    assert as_image(image) is image


def test_grey_images_of_one_channel_lose_it_and_become_rgb() -> None:
    grey = np.arange(35, dtype=np.uint8).reshape(5, 7)
    np.testing.assert_array_equal(as_image(grey[..., None]), grey)
    rgb = as_rgb(grey)
    assert rgb.shape == (5, 7, 3) and rgb.flags.c_contiguous
    np.testing.assert_array_equal(rgb, np.stack([grey] * 3, axis=2))
    colour = np.zeros((5, 7, 3), np.uint8)
    assert as_rgb(colour) is colour and as_rgb(colour[:, ::2]).flags.c_contiguous


@pytest.mark.parametrize(
    "image",
    [
        None,
        np.zeros((5, 7)),
        np.zeros((5, 7, 4), np.uint8),
        np.zeros(9, np.uint8),
        np.zeros((2, 5, 7, 3), np.uint8),
        np.zeros((0, 7, 3), np.uint8),
    ],
)
def test_other_arrays_are_refused_in_a_sentence(image: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"^an image must be .*, this one is"):
        as_image(image)


def test_images_below_the_minimum_side_are_refused() -> None:
    with pytest.raises(InputError, match=r"at least 16 px on each side, this one is \(15, 40\)"):
        as_image(np.zeros((15, 40), np.uint8), 16)


def test_images_are_halved_to_the_means_of_their_areas() -> None:
    """Against plain means of blocks; a step of halves rounds, each by half a level at most."""
    image = np.random.default_rng(0).integers(0, 256, (96, 120, 3), dtype=np.uint8)
    for factor in (2, 4, 8):
        size = (120 // factor, 96 // factor)
        blocks = image.reshape(size[1], factor, size[0], factor, 3).mean(axis=(1, 3))
        reduced = reduce_image(image, size)
        assert reduced.shape == (size[1], size[0], 3) and reduced.dtype == np.uint8
        assert np.abs(reduced - blocks).max() <= 1.6


@pytest.mark.parametrize("size", [(225, 400), (27, 48), (100, 31)])
def test_a_ramp_stays_a_ramp_when_it_is_reduced_by_fractions(size: tuple[int, int]) -> None:
    ramp = np.tile(np.linspace(0, 255, 540).astype(np.uint8), (960, 1))
    wanted = (np.arange(size[0]) + 0.5) * 540 / size[0] * 255 / 540
    assert np.abs(reduce_image(ramp, size).astype(float) - wanted).max() < 2.5


def test_an_image_of_the_size_wanted_is_left_alone() -> None:
    image = np.zeros((5, 7), np.uint8)
    assert reduce_image(image, (7, 5)) is image
