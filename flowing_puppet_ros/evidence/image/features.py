# SPDX-License-Identifier: Apache-2.0
"""Orientation maps of an image at any cell size, from which steered HOG descriptors are read.

A descriptor is the histogram of gradient orientations of a cell, weighted by magnitude (Dalal and Triggs, CVPR 2005),
without the gradient's sign. It is stored as the Fourier coefficients of that histogram up to the fourth order: nine
numbers, as many as nine bins, which rotate exactly with the frame of reference (Liu et al., IJCV 2014).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from flowing_puppet_ros.arrays import F32, U8, Array
from flowing_puppet_ros.images import as_rgb
from flowing_puppet_ros.process.threads import one_opencv_thread

ORDERS = 4  # of the Fourier series of a descriptor
CHANNELS = 2 * ORDERS + 1
"""Values of a descriptor: a_0, then (a_k cos, a_k sin) of the k-th order."""

CELL_PX = 4
"""Side of a cell, in pixels of the level from which it is read."""

LEVELS_PER_OCTAVE = 4
"""Levels of the pyramid per octave."""

MAX_LEVEL_PIXELS = 4e6
"""Maximum number of pixels of a level; at 9 float32 each, that takes 144 MB."""

_POOLING_PX = 0.41 * CELL_PX  # standard deviation of a cell with bilinear sharing between neighbours
_BLOCK_PX = 1.0 * CELL_PX  # standard deviation of the surroundings by which a cell is normalised
_NOISE_FLOOR = 2.0  # grey levels per pixel: gradients below are not amplified by the normalisation


@dataclass(frozen=True, slots=True, eq=False)
class OrientationMap:
    """Descriptors at every pixel of a level: `values` (h, w, CHANNELS), `scale` (2,) level pixels per image pixel."""

    values: F32
    scale: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class ImageFeatures:
    """Orientation maps of one `image` (H, W, 3) RGB uint8, each computed at its first use."""

    image: U8
    _levels: dict[int, OrientationMap] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, image: U8) -> ImageFeatures:
        """Prepare the features of an RGB (H, W, 3) or grey (H, W) uint8 image; InputError for anything else."""
        return cls(as_rgb(image))

    def find_levels(self, cell: Array) -> NDArray[np.intp]:
        """Return the numbers (...,) of the levels whose cells are closest to `cell` (...,) image pixels wide.

        Images are enlarged at most twofold, and to MAX_LEVEL_PIXELS: smaller cells are read as larger ones.
        """
        finest = max(
            -LEVELS_PER_OCTAVE,
            math.ceil(LEVELS_PER_OCTAVE / 2 * math.log2(self.image[:, :, 0].size / MAX_LEVEL_PIXELS)),
        )
        return np.asarray(
            np.maximum(np.rint(LEVELS_PER_OCTAVE * np.log2(np.asarray(cell) / CELL_PX)), finest), dtype=np.intp
        )

    def level(self, number: int) -> OrientationMap:
        """Return the orientation map in which a cell is CELL_PX * 2^(number / LEVELS_PER_OCTAVE) image pixels wide."""
        if number not in self._levels:
            # Results may depend on the number of threads otherwise.
            with one_opencv_thread():
                self._levels[number] = orientation_map(self.image, 2.0 ** (-number / LEVELS_PER_OCTAVE))
        return self._levels[number]


def orientation_map(image: Array, factor: float) -> OrientationMap:
    """Compute the orientation map of an `image` (H, W, 3), grey levels of any type, resized by `factor`."""
    height, width = image.shape[:2]
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    method = cv2.INTER_AREA if factor < 1.0 else cv2.INTER_LINEAR
    resized = np.asarray(cv2.resize(image, size, interpolation=method), np.float32)
    padded = np.pad(resized, ((1, 1), (1, 1), (0, 0)), mode="edge")
    histogram = cv2.GaussianBlur(_histogram(padded), (0, 0), _POOLING_PX, borderType=cv2.BORDER_REPLICATE)
    histogram = np.asarray(histogram, np.float32).reshape(size[1], size[0], CHANNELS)
    energy = np.ascontiguousarray(histogram[:, :, 0])
    around = cv2.GaussianBlur(energy, (0, 0), _BLOCK_PX, borderType=cv2.BORDER_REPLICATE).reshape(energy.shape)
    histogram /= np.asarray(around + _NOISE_FLOOR, np.float32)[:, :, None]
    return OrientationMap(histogram, (size[0] / width, size[1] / height))


@njit(cache=True, nogil=True)
def _histogram(padded: F32) -> F32:
    """Return magnitude times e^{2ik phi} of the strongest channel's gradient at the inner pixels of `padded`."""
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
