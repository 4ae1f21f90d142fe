# SPDX-License-Identifier: Apache-2.0
"""Images that come in, RGB or grey, 8 bits a channel: their check and their reduction."""

from __future__ import annotations

import cv2
import numpy as np

from flowing_puppet_ros.arrays import Array, Image
from flowing_puppet_ros.errors import InputError


def as_image(image: Array, min_side: int = 1) -> Image:
    """Return the pixels of an image (H, W, 3) or (H, W) uint8; those of (H, W, 1) as (H, W).

    InputError for any other array, and for an image of less than `min_side` pixels in width or height.
    """
    pixels = np.asarray(image)
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[:, :, 0]
    if pixels.dtype != np.uint8 or pixels.ndim not in (2, 3) or pixels.shape[2:] not in ((), (3,)):
        raise InputError(f"an image must be RGB or grey uint8, this one is {pixels.dtype} of shape {pixels.shape}")
    if min(pixels.shape[:2]) < min_side:
        raise InputError(f"an image must be at least {min_side} px on each side, this one is {pixels.shape[:2]}")
    return pixels


def as_rgb(image: Array) -> Image:
    """Return the contiguous pixels (H, W, 3) of an RGB or grey image; InputError as in `as_image`."""
    pixels = as_image(image)
    return np.ascontiguousarray(pixels if pixels.ndim == 3 else np.repeat(pixels[:, :, None], 3, axis=2))


def reduce_image(image: Image, size: tuple[int, int]) -> Image:
    """Return an image (H, W, 3) or (H, W) at a smaller `size` (width, height): means over the pixels' areas.

    It is halved as long as that is possible without a rest, and what is left is done by fractions of the halved pixels,
    which cost ten times as much for each pixel that is read; that blurs fine texture a little.
    """
    height, width = image.shape[:2]
    while not (width % 2 or height % 2) and width >= 2 * size[0] and height >= 2 * size[1]:
        width, height = width // 2, height // 2
        image = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    if (width, height) != size:
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return image
