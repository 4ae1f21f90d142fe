# SPDX-License-Identifier: Apache-2.0
"""Where people stand in an image and how large: rigid head-and-shoulders filters on a pyramid of HOG features.

S, the person's scale, is the shoulder width in px (for a person seen from the side, what it would be from the front).
A filter has 11 x 12 cells of S / 7; one pyramid level holds the people of one S, levels are a quarter octave apart.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from flowing_puppet_ros.arrays import F32, U8
from flowing_puppet_ros.evidence.image.hog import OUTSIDE_INDEX, hog
from flowing_puppet_ros.image.detector.boosted_trees import COLOUR_CHANNELS, cell_colours, quantise_features

ROWS, COLUMNS = 11, 12  # cells of a filter
CELLS_PER_SCALE = 7  # cells of a filter per S
CELL_PX = 6  # of a cell in the resized image
PAD_CELLS = 5  # added around a level, so that people cut off by the border are found
LEVEL_FACTOR = 2**0.25  # between the scales of two levels
MAX_OVERLAP = 0.6  # intersection over union from which only the better of two windows is kept
MAX_LEVEL_PEAKS = 60  # best windows of a level that are kept


@dataclass(frozen=True, slots=True, eq=False)
class RootFilters:
    """K rigid filters.

    `filters` (K, 11, 12, 32) and `bias` (K,) give the log-odds that a window shows a person; `offsets` (K, 2, 2) are
    the mean neck and face relative to the window's centre, in units of S, x right, y down.
    """

    filters: F32
    bias: F32
    offsets: F32


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """One pyramid level: HOG (R, C, 32) and colours (R, C, 3), padded by PAD_CELLS of `cell` px of the input image."""

    features: F32
    colours: F32
    cell: float

    @property
    def scale(self) -> float:
        """S of the people that this level shows."""
        return CELLS_PER_SCALE * self.cell

    def center(self, row: int, column: int) -> tuple[float, float]:
        """Return the centre (x, y), px of the input image, of the window whose first cell is (row, column)."""
        return (column - PAD_CELLS + COLUMNS / 2) * self.cell - 0.5, (row - PAD_CELLS + ROWS / 2) * self.cell - 0.5


@dataclass(frozen=True, slots=True, eq=False)
class RootCandidate:
    """A window that may show a person: its score, level and first cell, and where neck and face (x, y) px would be."""

    score: float
    level: Level
    row: int
    column: int
    neck: tuple[float, float]
    face: tuple[float, float]

    @property
    def scale(self) -> float:
        """S in px."""
        return self.level.scale

    @property
    def center(self) -> tuple[float, float]:
        """The window's centre (x, y) px."""
        return self.level.center(self.row, self.column)

    @property
    def codes(self) -> U8:
        """Codes (FEATURES,) of the window for the boosted trees."""
        return quantise_features(self.level.features, self.level.colours, self.row, self.column)


def make_pyramid(image: U8, min_width: float) -> Iterator[Level]:
    """Yield levels for S from `min_width` px until shoulders are wider than the whole image, finest first."""
    scale = min_width
    while True:
        yield make_level(image, scale)
        scale *= LEVEL_FACTOR
        if scale > max(image.shape[:2]):
            return


def make_level(image: U8, scale: float) -> Level:
    """Make the level that shows people of the given S, for an image (H, W, 3) or (H, W)."""
    factor = CELL_PX * CELLS_PER_SCALE / scale
    resized = resize(image, factor)
    features = hog(resized, CELL_PX)
    rows, columns = features.shape[:2]
    colours = np.zeros((rows + 2 * PAD_CELLS, columns + 2 * PAD_CELLS, COLOUR_CHANNELS), np.float32)
    if rows and columns:
        inside = cell_colours(resized[: rows * CELL_PX, : columns * CELL_PX], rows, columns)
        colours = np.pad(inside, ((PAD_CELLS, PAD_CELLS), (PAD_CELLS, PAD_CELLS), (0, 0)), mode="edge")
    return Level(pad_cells(features, PAD_CELLS), colours, CELL_PX / factor)


def resize(image: U8, factor: float) -> U8:
    """Resize an image by `factor`, with averaging when it shrinks; at least one pixel remains."""
    height, width = image.shape[:2]
    size = max(1, round(width * factor)), max(1, round(height * factor))
    method = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size, interpolation=method), dtype=np.uint8)


def pad_cells(features: F32, cells: int) -> F32:
    """Frame `features` (R, C, 32) with cells that are marked as outside the image."""
    rows, columns, dimensions = features.shape
    padded = np.zeros((rows + 2 * cells, columns + 2 * cells, dimensions), np.float32)
    padded[..., OUTSIDE_INDEX] = 1
    padded[cells : cells + rows, cells : cells + columns] = features
    return padded


def correlate(features: F32, filters: F32) -> F32:
    """Correlate `features` (R, C, D) with `filters` (K, r, c, D): (R - r + 1, C - c + 1, K), where they fit inside."""
    count, rows, columns, dimensions = filters.shape
    height, width = features.shape[0] - rows + 1, features.shape[1] - columns + 1
    if height <= 0 or width <= 0:
        return np.zeros((max(height, 0), max(width, 0), count), np.float32)
    strips = sliding_window_view(features, columns, axis=1).transpose(0, 1, 3, 2)  # (R, width, columns, D)
    flat = strips.reshape(features.shape[0] * width, columns * dimensions)
    weights = filters.transpose(2, 3, 1, 0).reshape(columns * dimensions, rows * count)
    partial = (flat @ weights).reshape(features.shape[0], width, rows, count)
    total = partial[:height, :, 0].copy()
    for row in range(1, rows):
        total += partial[row : row + height, :, row]
    return total


def scan(image: U8, root: RootFilters, min_width: float, count: int, min_log_odds: float) -> list[RootCandidate]:
    """Return the `count` best windows of at least `min_log_odds`, best first, without overlapping ones."""
    found: list[RootCandidate] = []
    for level in make_pyramid(image, min_width):
        found += _find_peaks(level, correlate(level.features, root.filters) + root.bias, root, min_log_odds)
    return non_max_suppression(found, count)


def _find_peaks(level: Level, scores: F32, root: RootFilters, min_log_odds: float) -> list[RootCandidate]:
    """Return the windows of one level that score at least as high as their eight neighbours."""
    component = scores.argmax(axis=2)
    best = np.ascontiguousarray(scores.max(axis=2))
    if best.size == 0:
        return []
    highest = cv2.dilate(best, np.ones((3, 3), np.uint8))
    rows, columns = np.nonzero((best >= highest) & (best >= min_log_odds))
    order = np.argsort(-best[rows, columns], kind="stable")[:MAX_LEVEL_PEAKS]
    return [
        make_candidate(level, int(r), int(c), int(component[r, c]), float(best[r, c]), root)
        for r, c in zip(rows[order], columns[order], strict=True)
    ]


def make_candidate(
    level: Level, row: int, column: int, component: int, score: float, root: RootFilters
) -> RootCandidate:
    """Make the candidate of the window at (row, column) of a level, on which filter `component` responds most."""
    x, y = level.center(row, column)
    neck, face = (np.array([x, y]) + level.scale * root.offsets[component].astype(np.float64)).tolist()
    return RootCandidate(score, level, row, column, (neck[0], neck[1]), (face[0], face[1]))


def non_max_suppression(candidates: list[RootCandidate], count: int) -> list[RootCandidate]:
    """Return the `count` best candidates, none of which overlaps a better one by MAX_OVERLAP or more."""
    kept: list[RootCandidate] = []
    for one in sorted(candidates, key=lambda c: -c.score):
        if all(window_iou(one, other) < MAX_OVERLAP for other in kept):
            kept.append(one)
            if len(kept) == count:
                break
    return kept


def window_iou(a: RootCandidate, b: RootCandidate) -> float:
    """Return the intersection over union of two windows."""
    area = 1.0
    for axis, cells in enumerate((COLUMNS, ROWS)):
        half_a, half_b = (cells / CELLS_PER_SCALE / 2 * one.scale for one in (a, b))
        low = max(a.center[axis] - half_a, b.center[axis] - half_b)
        area *= max(0.0, min(a.center[axis] + half_a, b.center[axis] + half_b) - low)
    unit_area = ROWS * COLUMNS / CELLS_PER_SCALE**2
    return area / (unit_area * (a.scale**2 + b.scale**2) - area)
