# SPDX-License-Identifier: Apache-2.0
"""Rescoring of windows that may show a person: boosted decision trees over gradients and colours.

The trees see what rigid filters miss: 16 x 16 cells of S / 7 around head and shoulders. Each cell has the 32 dimensions
of HOG and its colour (CIE L*a*b*) less the window's mean, every value quantised to 0..31.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F32, I32, U8
from flowing_puppet_ros.evidence.image.hog import DIMENSIONS

WINDOW_CELLS = 16  # cells on each side of a window
CELLS_ABOVE, CELLS_LEFT = 1, 2  # of the window beyond the head-and-shoulders filters
COLOUR_CHANNELS = 3
FEATURES = WINDOW_CELLS * WINDOW_CELLS * (DIMENSIONS + COLOUR_CHANNELS)
BINS = 32  # codes of a value
HOG_RANGE = 0.4  # HOG values from here on get the last code
COLOUR_RANGE = 0.3  # colours, in +-1, beyond this get the first or the last code


@dataclass(frozen=True, slots=True, eq=False)
class BoostedTrees:
    """T complete trees of depth D: go right where code > threshold; the sum of the leaves is the score.

    Attributes:
        feature: (T, 2**D - 1) int32, the code that an inner node compares; nodes breadth first.
        threshold: (T, 2**D - 1) uint8 of the inner nodes.
        leaves: (T, 2**D) values.
    """

    feature: I32
    threshold: U8
    leaves: F32

    def score(self, codes: U8) -> F32:
        """Return the scores (N,) of windows with `codes` (N, FEATURES)."""
        return np.asarray(_score(codes, self.feature, self.threshold, self.leaves), np.float32)


def cell_colours(image: U8, rows: int, columns: int) -> F32:
    """Return CIE L*a*b* (rows, columns, 3), each divided by 255, averaged over the cells that cover the image."""
    coloured = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
    means = cv2.resize(coloured, (columns, rows), interpolation=cv2.INTER_AREA)
    colours = np.asarray(cv2.cvtColor(means, cv2.COLOR_RGB2LAB), np.float32)
    colours /= 255
    return colours


def quantise_features(features: F32, colours: F32, row: int, column: int) -> U8:
    """Return the codes (FEATURES,) of the window whose filters start at (row, column) of a level.

    `features` (R, C, 32) and `colours` (R, C, 3) of the level; its border is repeated beyond it.
    """
    rows = np.clip(np.arange(row - CELLS_ABOVE, row - CELLS_ABOVE + WINDOW_CELLS), 0, features.shape[0] - 1)
    columns = np.clip(np.arange(column - CELLS_LEFT, column - CELLS_LEFT + WINDOW_CELLS), 0, features.shape[1] - 1)
    gradients = features[rows[:, None], columns[None, :]] * np.float32(BINS / HOG_RANGE)
    colour = colours[rows[:, None], columns[None, :]]
    relative = (colour - colour.mean(axis=(0, 1))) * np.float32(BINS / 2 / COLOUR_RANGE) + np.float32(BINS / 2)
    both = np.concatenate([gradients, relative], axis=2)
    return np.clip(both, 0, BINS - 1).astype(np.uint8).ravel()


@njit(cache=True, nogil=True)
def _score(codes: U8, feature: I32, threshold: U8, leaves: F32) -> Any:
    inner = feature.shape[1]
    out = np.zeros(len(codes), np.float32)
    for i in range(len(codes)):
        for tree in range(len(feature)):
            node = 0
            while node < inner:
                node = 2 * node + 1 + (1 if codes[i, feature[tree, node]] > threshold[tree, node] else 0)
            out[i] += leaves[tree, node - inner]
    return out
