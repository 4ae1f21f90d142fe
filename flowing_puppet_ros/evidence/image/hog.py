# SPDX-License-Identifier: Apache-2.0
"""Histograms of oriented gradients on a grid of square cells, in the 31 dimensions of Felzenszwalb et al., PAMI 2010.

P. F. Felzenszwalb, R. B. Girshick, D. McAllester, D. Ramanan: Object Detection with Discriminatively Trained
Part-Based Models, section 6. Cells at the border are normalised with their own replicas beyond it, so that no row or
column is lost. The 32nd dimension is 0 inside the image; code that pads the grid sets it to 1.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F32, U8

SIGNED = 18  # orientations that distinguish dark-to-bright from bright-to-dark ...
UNSIGNED = 9  # ... and that do not
DIMENSIONS = 32
OUTSIDE_INDEX = 31  # of the dimension that is 1 in cells outside the image
MAX_VALUE = 0.2  # at which normalised votes are truncated
TEXTURE_WEIGHT = 0.2357  # of the four gradient energies
MIN_ENERGY = 1e-4  # keeps flat blocks from a division by zero


def hog(image: U8, cell: int) -> F32:
    """Compute HOG (H // cell, W // cell, 32) of `image` (H, W, 3) or (H, W); `cell` in px, remainders are left out.

    The gradient of the strongest channel votes at its orientation, linearly shared by the four nearest cells.
    """
    pixels = np.ascontiguousarray(image.reshape(*image.shape[:2], -1))
    rows, columns = image.shape[0] // cell, image.shape[1] // cell
    if rows == 0 or columns == 0:
        return np.zeros((rows, columns, DIMENSIONS), np.float32)
    orientation, magnitude = _gradient_table()
    histogram = _histograms(pixels, cell, rows, columns, orientation, magnitude)
    features: F32 = _normalise(histogram)
    return features


@cache
def _gradient_table() -> tuple[U8, F32]:
    """Tabulate orientation bin and magnitude of the gradient (dx, dy), both at [dy + 255, dx + 255]."""
    dy, dx = np.mgrid[-255:256, -255:256].astype(np.float64)
    angles = np.arange(SIGNED) * (2 * math.pi / SIGNED)
    scores = np.stack([math.cos(angle) * dx + math.sin(angle) * dy for angle in angles])
    return scores.argmax(axis=0).astype(np.uint8), np.hypot(dx, dy).astype(np.float32)


@njit(cache=True, nogil=True)
def _histograms(pixels: U8, cell: int, rows: int, columns: int, orientation: U8, magnitude: F32) -> Any:
    """Collect the votes (rows, columns, 18) of the pixels of whole cells, without the image's outermost pixels."""
    votes = np.zeros((rows + 2, columns + 2, SIGNED), np.float32)
    height, width, channels = pixels.shape
    for y in range(1, min(rows * cell, height - 1)):
        at_y = np.float32((y + 0.5) / cell + 0.5)
        row = int(at_y)
        low_y = at_y - np.float32(row)
        for x in range(1, min(columns * cell, width - 1)):
            best, bin_ = np.float32(-1.0), np.int64(0)
            for c in range(channels):
                dx = np.int64(pixels[y, x + 1, c]) - np.int64(pixels[y, x - 1, c]) + 255
                dy = np.int64(pixels[y + 1, x, c]) - np.int64(pixels[y - 1, x, c]) + 255
                if magnitude[dy, dx] > best:
                    best, bin_ = magnitude[dy, dx], np.int64(orientation[dy, dx])
            if best <= 0:
                continue
            at_x = np.float32((x + 0.5) / cell + 0.5)
            column = int(at_x)
            low_x = at_x - np.float32(column)
            upper, lower = best * (np.float32(1.0) - low_y), best * low_y
            votes[row, column, bin_] += upper * (np.float32(1.0) - low_x)
            votes[row, column + 1, bin_] += upper * low_x
            votes[row + 1, column, bin_] += lower * (np.float32(1.0) - low_x)
            votes[row + 1, column + 1, bin_] += lower * low_x
    return votes[1 : rows + 1, 1 : columns + 1].copy()


@njit(cache=True, nogil=True)
def _normalise(histogram: F32) -> Any:
    """Return the features (rows, columns, 32): 18 signed, 9 unsigned orientations, 4 gradient energies, and 0."""
    rows, columns = histogram.shape[:2]
    energy = np.zeros((rows + 2, columns + 2), np.float32)
    for r in range(rows + 2):
        for c in range(columns + 2):
            at = histogram[min(max(r - 1, 0), rows - 1), min(max(c - 1, 0), columns - 1)]
            for o in range(UNSIGNED):
                energy[r, c] += (at[o] + at[o + UNSIGNED]) ** 2
    features = np.zeros((rows, columns, DIMENSIONS), np.float32)
    for r in range(rows):
        for c in range(columns):
            at, out = histogram[r, c], features[r, c]
            for block in range(4):
                y, x = r + block // 2, c + block % 2
                total = energy[y, x] + energy[y, x + 1] + energy[y + 1, x] + energy[y + 1, x + 1]
                scale = np.float32(1.0) / np.sqrt(total + np.float32(MIN_ENERGY))
                strength = np.float32(0.0)
                for o in range(SIGNED):
                    value = min(at[o] * scale, np.float32(MAX_VALUE))
                    out[o] += np.float32(0.5) * value
                    strength += value
                for o in range(UNSIGNED):
                    both = (at[o] + at[o + UNSIGNED]) * scale
                    out[SIGNED + o] += np.float32(0.5) * min(both, np.float32(MAX_VALUE))
                out[SIGNED + UNSIGNED + block] = np.float32(TEXTURE_WEIGHT) * strength
    return features
