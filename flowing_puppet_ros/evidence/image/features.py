# SPDX-License-Identifier: Apache-2.0
"""Orientation maps of an image at any cell size: what steered HOG descriptors are read from.

A descriptor is the histogram of gradient orientations of a cell, weighted by magnitude (Dalal and Triggs, CVPR 2005),
without the gradient's sign. It is kept as the Fourier coefficients of that histogram up to the fourth order: nine
numbers, as many as nine bins, which a turn of the frame of reference changes exactly (Liu et al., IJCV 2014).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from flowing_puppet_ros.arrays import F32, U8, Array
from flowing_puppet_ros.errors import InputError

ORDERS = 4
CHANNELS = 2 * ORDERS + 1
"""Numbers of a descriptor: a_0, then (a_k cos, a_k sin) of the k-th order."""

CELL = 4
"""Side of a cell, in pixels of the level that it is read from."""

STEPS = 4
"""Levels of the pyramid an octave."""

LARGEST = 4e6
"""Pixels of the largest level; at 9 float32 each it takes 144 MB."""

_POOLING = 0.41 * CELL  # px: standard deviation of a cell with bilinear sharing between neighbours
_BLOCK = 1.0 * CELL  # px: standard deviation of the surroundings that a cell is normalised by
_NOISE = 2.0  # grey levels a pixel: gradients below are not blown up by the normalisation


@dataclass(frozen=True, slots=True, eq=False)
class OrientationMap:
    """Descriptors at every pixel of one level: `values` (h,w,CHANNELS) float32, `scale` (2,) level px an image px."""

    values: F32
    scale: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class ImageFeatures:
    """The orientation maps of one image, made when they are first asked for. `image` (H,W,3) RGB uint8."""

    image: U8
    _levels: dict[int, OrientationMap] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, image: U8) -> ImageFeatures:
        """Features of an RGB (H,W,3) or grey (H,W) uint8 image; InputError for anything else."""
        cv2.setNumThreads(1)  # results may depend on the number of threads otherwise
        return cls(as_rgb(image))

    def levels_of(self, cell: Array) -> NDArray[np.intp]:
        """Numbers (...,) of the levels whose cells are nearest to `cell` (...,) image pixels wide.

        Images are enlarged at most twice, and to LARGEST pixels: smaller cells are read from larger ones.
        """
        finest = max(-STEPS, math.ceil(STEPS / 2 * math.log2(self.image[:, :, 0].size / LARGEST)))
        return np.asarray(np.maximum(np.rint(STEPS * np.log2(np.asarray(cell) / CELL)), finest), dtype=np.intp)

    def level(self, number: int) -> OrientationMap:
        """Orientation map in which a cell is CELL * 2^(number / STEPS) image pixels wide."""
        if number not in self._levels:
            self._levels[number] = orientation_map(self.image, 2.0 ** (-number / STEPS))
        return self._levels[number]


def as_rgb(image: U8) -> U8:
    """Return an RGB (H,W,3) or grey (H,W) uint8 image as RGB; InputError for anything else."""
    if image.dtype == np.uint8 and image.ndim == 2:
        image = np.repeat(image[:, :, None], 3, axis=2)
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise InputError(f"the image has the shape {image.shape} of {image.dtype}; it must be RGB or grey uint8")
    return np.ascontiguousarray(image)


def orientation_map(image: Array, factor: float) -> OrientationMap:
    """Orientation map of an image (H,W,3), grey levels of any type, that is first resized by a factor."""
    height, width = image.shape[:2]
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    method = cv2.INTER_AREA if factor < 1.0 else cv2.INTER_LINEAR
    resized = np.asarray(cv2.resize(image, size, interpolation=method), np.float32)
    padded = np.pad(resized, ((1, 1), (1, 1), (0, 0)), mode="edge")
    histogram = cv2.GaussianBlur(_histogram(padded), (0, 0), _POOLING, borderType=cv2.BORDER_REPLICATE)
    histogram = np.asarray(histogram, np.float32).reshape(size[1], size[0], CHANNELS)
    energy = np.ascontiguousarray(histogram[:, :, 0])
    around = cv2.GaussianBlur(energy, (0, 0), _BLOCK, borderType=cv2.BORDER_REPLICATE).reshape(energy.shape)
    histogram /= np.asarray(around + _NOISE, np.float32)[:, :, None]
    return OrientationMap(histogram, (size[0] / width, size[1] / height))


@njit(cache=True, nogil=True)
def _histogram(padded: F32) -> F32:
    """Magnitude times e^{2ik phi} of the strongest channel's gradient at every inner pixel of `padded` (h+2,w+2,3)."""
    height, width = padded.shape[0] - 2, padded.shape[1] - 2
    out = np.zeros((height, width, 2 * ORDERS + 1), np.float32)
    for y in range(height):
        for x in range(width):
            best, gx, gy = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for c in range(3):
                dx = padded[y + 1, x + 2, c] - padded[y + 1, x, c]
                dy = padded[y + 2, x + 1, c] - padded[y, x + 1, c]
                squared = dx * dx + dy * dy
                if squared > best:
                    best, gx, gy = squared, dx, dy
            if best <= 0.0:
                continue
            magnitude = np.sqrt(best) * np.float32(0.5)
            cosine, sine = (gx * gx - gy * gy) / best, np.float32(2.0) * gx * gy / best
            real, imaginary = magnitude, np.float32(0.0)
            out[y, x, 0] = magnitude
            for k in range(ORDERS):
                real, imaginary = real * cosine - imaginary * sine, real * sine + imaginary * cosine
                out[y, x, 2 * k + 1] = real
                out[y, x, 2 * k + 2] = imaginary
    return out
