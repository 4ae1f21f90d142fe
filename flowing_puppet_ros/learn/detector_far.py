# SPDX-License-Identifier: Apache-2.0
"""People far away, made of people close by: shrunk, with all that is around them, and set into another image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flowing_puppet_ros.learn.detector_data import Example, center_of

type Array = np.ndarray[Any, Any]

SMALLEST = 18.0  # px: S of the smallest people that are made
LEAST_SHRINK, MOST_SHRINK = 0.8, 0.22
ASIDE, ABOVE = 1.6, 1.3  # units of S from the centre of head and shoulders beyond which an image shows no person
LEAST_FREE = 40  # px
TRIES = 30


def far_away(example: Example, others: Sequence[Example], rng: np.random.Generator) -> Example | None:
    """The example shrunk at random into what is free in another one's image; None when the person is small already."""
    least = SMALLEST / example.scale
    if least >= LEAST_SHRINK:
        return None
    factor = float(np.exp(rng.uniform(np.log(max(least, MOST_SHRINK)), np.log(LEAST_SHRINK))))
    for _ in range(TRIES):
        background = free_part(others[int(rng.integers(len(others)))])
        if background is not None:
            return _set_into(background, example.resized(factor), example.image.shape[:2], rng)
    return None


def free_part(example: Example) -> NDArray[np.uint8] | None:
    """The largest part of an example's image beside or above the person; None when there is hardly any."""
    x, y = center_of(example)
    left, right = (max(0, int(x + sign * ASIDE * example.scale)) for sign in (-1, 1))
    parts = example.image[:, :left], example.image[:, right:], example.image[: max(0, int(y - ABOVE * example.scale))]
    largest = max(parts, key=lambda part: part.shape[0] * part.shape[1])
    return largest if min(largest.shape[:2]) > LEAST_FREE else None


def _set_into(
    background: NDArray[np.uint8], example: Example, size: tuple[int, ...], rng: np.random.Generator
) -> Example:
    """The example's whole image at a random place of an image of `size` (height, width) that the background fills."""
    height, width = size
    # OpenCV needs rows that follow one another.
    canvas = np.asarray(cv2.resize(np.ascontiguousarray(background), (width, height)), np.uint8)
    own_height, own_width = example.image.shape[:2]
    x, y = int(rng.integers(0, width - own_width + 1)), int(rng.integers(0, height - own_height + 1))
    canvas[y : y + own_height, x : x + own_width] = example.image
    corner = np.array([x, y])
    others = example.others.copy()
    others[:, :2] += corner
    return replace(example, image=canvas, joints=example.joints + corner, others=others)
