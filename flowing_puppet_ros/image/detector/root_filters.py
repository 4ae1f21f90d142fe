# SPDX-License-Identifier: Apache-2.0
"""Where people stand in an image and how large: rigid head-and-shoulders filters on a pyramid of HOG features.

S, the person's scale, is the shoulder width in px (of somebody seen from the side, what it would be from the front).
A filter has 11 x 12 cells of S / 7; one pyramid level holds the people of one S, levels are a quarter octave apart.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from flowing_puppet_ros.arrays import F32, U8
from flowing_puppet_ros.evidence.image.hog import OUTSIDE, hog
from flowing_puppet_ros.image.detector.boosted_trees import COLOURS, cell_colours, quantise_features

ROWS, COLUMNS = 11, 12  # cells of a filter
CELLS_PER_SCALE = 7
CELL = 6  # px of a cell in the resized image
PAD = 5  # cells added around a level, so that people cut by the border are found
STEP = 2**0.25  # between the scales of two levels
OVERLAP = 0.6  # intersection over union of two windows of which only the better is kept
PEAKS = 60  # best windows of a level that are looked at


@dataclass(frozen=True, slots=True, eq=False)
class RootFilters:
    """K rigid filters.

    `filters` (K, 11, 12, 32) and `bias` (K,) give the log-odds that a window shows a person; `offsets` (K, 2, 2) are
    the mean neck and face from the window's centre, in units of S, x right, y down.
    """

    filters: F32
    bias: F32
    offsets: F32


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """One pyramid level: HOG (R, C, 32) and colours (R, C, 3), padded by PAD cells of `cell` px of the input image."""

    features: F32
    colours: F32
    cell: float

    @property
    def scale(self) -> float:
        """S of the people that this level shows."""
        return CELLS_PER_SCALE * self.cell

    def center(self, row: int, column: int) -> tuple[float, float]:
        """Centre (x, y), px of the input image, of the window whose first cell is (row, column)."""
        return (column - PAD + COLUMNS / 2) * self.cell - 0.5, (row - PAD + ROWS / 2) * self.cell - 0.5


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
        """What the second look sees of the window."""
        return quantise_features(self.level.features, self.level.colours, self.row, self.column)


def pyramid(image: U8, smallest: float) -> Iterator[Level]:
    """Levels for S from `smallest` px until the whole image is less wide than shoulders, finest first."""
    scale = smallest
    while True:
        yield make_level(image, scale)
        scale *= STEP
        if scale > max(image.shape[:2]):
            return


def make_level(image: U8, scale: float) -> Level:
    """The level that shows people of the given S, for an image (H, W, 3) or (H, W)."""
    factor = CELL * CELLS_PER_SCALE / scale
    resized = resize(image, factor)
    features = hog(resized, CELL)
    rows, columns = features.shape[:2]
    colours = np.zeros((rows + 2 * PAD, columns + 2 * PAD, COLOURS), np.float32)
    if rows and columns:
        inside = cell_colours(resized[: rows * CELL, : columns * CELL], rows, columns)
        colours = np.pad(inside, ((PAD, PAD), (PAD, PAD), (0, 0)), mode="edge")
    return Level(pad(features, PAD), colours, CELL / factor)


def resize(image: U8, factor: float) -> U8:
    """The image `factor` times as large, with averaging when it shrinks; at least one pixel."""
    height, width = image.shape[:2]
    size = max(1, round(width * factor)), max(1, round(height * factor))
    method = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size, interpolation=method), dtype=np.uint8)


def pad(features: F32, cells: int) -> F32:
    """`features` (R, C, 32) with a frame of cells that are marked to lie outside the image."""
    rows, columns, dimensions = features.shape
    padded = np.zeros((rows + 2 * cells, columns + 2 * cells, dimensions), np.float32)
    padded[..., OUTSIDE] = 1
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


def scan(image: U8, root: RootFilters, smallest: float, count: int, least: float) -> list[RootCandidate]:
    """The `count` best windows whose log-odds reach `least`, best first, without those that overlap a better one."""
    found: list[RootCandidate] = []
    for at in pyramid(image, smallest):
        found += _peaks(at, correlate(at.features, root.filters) + root.bias, root, least)
    return non_max_suppression(found, count)


def _peaks(at: Level, scores: F32, root: RootFilters, least: float) -> list[RootCandidate]:
    """Windows of one level that are better than their eight neighbours."""
    component = scores.argmax(axis=2)
    best = np.ascontiguousarray(scores.max(axis=2))
    if best.size == 0:
        return []
    highest = cv2.dilate(best, np.ones((3, 3), np.uint8))
    rows, columns = np.nonzero((best >= highest) & (best >= least))
    order = np.argsort(-best[rows, columns], kind="stable")[:PEAKS]
    return [
        candidate(at, int(r), int(c), int(component[r, c]), float(best[r, c]), root)
        for r, c in zip(rows[order], columns[order], strict=True)
    ]


def candidate(at: Level, row: int, column: int, component: int, score: float, root: RootFilters) -> RootCandidate:
    """The person that the window at (row, column) of a level shows when `component` is right."""
    x, y = at.center(row, column)
    neck, face = (np.array([x, y]) + at.scale * root.offsets[component].astype(np.float64)).tolist()
    return RootCandidate(score, at, row, column, (neck[0], neck[1]), (face[0], face[1]))


def non_max_suppression(candidates: list[RootCandidate], count: int) -> list[RootCandidate]:
    """The `count` best, each of which overlaps no better one by more than OVERLAP."""
    kept: list[RootCandidate] = []
    for one in sorted(candidates, key=lambda c: -c.score):
        if all(window_iou(one, other) < OVERLAP for other in kept):
            kept.append(one)
            if len(kept) == count:
                break
    return kept


def window_iou(a: RootCandidate, b: RootCandidate) -> float:
    """Intersection over union of two windows."""
    area = 1.0
    for axis, cells in enumerate((COLUMNS, ROWS)):
        half_a, half_b = (cells / CELLS_PER_SCALE / 2 * one.scale for one in (a, b))
        low = max(a.center[axis] - half_a, b.center[axis] - half_b)
        area *= max(0.0, min(a.center[axis] + half_a, b.center[axis] + half_b) - low)
    whole = ROWS * COLUMNS / CELLS_PER_SCALE**2
    return area / (whole * (a.scale**2 + b.scale**2) - area)
