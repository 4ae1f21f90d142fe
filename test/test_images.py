# SPDX-License-Identifier: Apache-2.0
"""What is taken for an image, and the one sentence for everything else."""

from __future__ import annotations

import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.images import as_image, as_rgb


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
