# SPDX-License-Identifier: Apache-2.0
"""The part filters of the detector: the window around a person, its features, and the filters' responses to them.

The window is 4.6 S wide and 4.4 S high in cells of S / 10 around the neck, S being the person's scale. To the 32
dimensions of HOG come four of colour: how much more frequent a cell's hue and its lightness are on the face, and on
the upper chest, than in the whole window (logarithm of the ratio of two histograms in CIE L*a*b*). In a grey image the
two dimensions of hue are 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F32, F64, I32, I64, U8, Bools
from flowing_puppet_ros.evidence.image.hog import DIMENSIONS, OUTSIDE_INDEX, hog
from flowing_puppet_ros.image.detector.pictorial_structure import FilterTree
from flowing_puppet_ros.image.detector.root_filters import correlate, pad_cells

CELLS_PER_SCALE = 10  # cells of the window per S
CELL_PX = 6  # of a cell in the resized window
NECK_COLUMN, NECK_ROW = 23, 20  # cells from the window's left and upper border to the neck
COLUMNS, ROWS = 46, 44  # cells of the window
FILTER_CELLS = 5  # on each side of a part filter
COLOUR_CHANNELS = 4  # hue and lightness, like the face and like the chest
FACE_RADIUS, CHEST_RADIUS, CHEST_OFFSET = 0.2, 0.25, 0.35  # units of S; the chest lies below the neck
HUE_BINS, LIGHT_BINS = 32, 16  # of a histogram, along a* and b* each, and along L*
MAX_LOG_RATIO = 3.0  # of two histograms: bound of a colour feature before it is scaled to +-1

PARTS = (
    *("neck", "face", "belly", "right_hip", "left_hip"),
    *(
        f"{side}_{part}"
        for side in ("right", "left")
        for part in ("shoulder", "upper_arm", "elbow", "forearm", "wrist")
    ),
)
"""Parts in the order of the tree; upper_arm and forearm lie midway between the joints."""
PARENTS = (-1, 0, 0, 2, 2, 0, 5, 6, 7, 8, 0, 10, 11, 12, 13)
"""Parent of each part, -1 for the root."""


@dataclass(frozen=True, slots=True, eq=False)
class FeatureWindow:
    """`features` (ROWS, COLUMNS, 36) around a neck; cell (x, y) has its centre at `origin` + `cell` * (x, y) px.

    `mirror` is the image's width when the window lies in its mirror image, else None.
    """

    features: F32
    origin: tuple[float, float]
    cell: float
    mirror: int | None = None

    @property
    def outside(self) -> float:
        """Share of the window that lies outside the image."""
        return float(np.mean(self.features[..., OUTSIDE_INDEX] > 0))

    def to_cells(self, points: F64) -> F64:
        """Convert image points (..., 2) px to grid coordinates (..., 2)."""
        cells: F64 = (self._mirror_points(np.asarray(points, np.float64)) - self.origin) / self.cell
        return cells

    def to_points(self, cells: F64) -> F64:
        """Convert grid coordinates (..., 2) to image points (..., 2) px."""
        points: F64 = np.asarray(cells, np.float64) * self.cell + self.origin
        return self._mirror_points(points)

    def _mirror_points(self, points: F64) -> F64:
        """Convert points (..., 2) px between the image and its mirror image if the window lies in that one."""
        if self.mirror is None:
            return points
        return np.stack([self.mirror - 1 - points[..., 0], points[..., 1]], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class PartFilters:
    """`filters` (L, 5, 5, 36), one per layer of `tree`."""

    filters: F32
    tree: FilterTree

    def respond(self, window: FeatureWindow) -> F32:
        """Return the responses (L, ROWS, COLUMNS) of all layers."""
        return filter_responses(window.features, self.filters)


def filter_responses(features: F32, filters: F32) -> F32:
    """Return the responses (L, ROWS, COLUMNS) of `filters` (L, 5, 5, D), each centred on the cell that it scores."""
    framed = pad_half_filter(features)
    return np.ascontiguousarray(correlate(framed, filters).transpose(2, 0, 1))


def pad_half_filter(features: F32) -> F32:
    """Frame `features` (R, C, D) with half a filter that is marked as outside."""
    return pad_cells(features, FILTER_CELLS // 2)


def extract_window(image: U8, neck: tuple[float, float], face: tuple[float, float], scale: float) -> FeatureWindow:
    """Extract the window of an image (H, W, 3) or (H, W) around `neck`, given `face` and the scale S, all in px."""
    step = scale / CELLS_PER_SCALE
    corner = np.array([neck[0] + 0.5 - (NECK_COLUMN + 0.5) * step, neck[1] + 0.5 - (NECK_ROW + 0.5) * step])
    size = np.array([image.shape[1], image.shape[0]])
    # Cells wholly outside the image stay empty: the crop starts with the first cell inside.
    skipped = np.maximum(0, np.ceil(-corner / step)).astype(int)
    cells = np.minimum(np.floor((size - corner) / step).astype(int), (COLUMNS, ROWS)) - skipped
    begin = np.maximum(0, np.round(corner + skipped * step)).astype(int)
    features = np.zeros((ROWS, COLUMNS, DIMENSIONS + COLOUR_CHANNELS), np.float32)
    features[..., OUTSIDE_INDEX] = 1
    origin = tuple((corner + 0.5 * step - 0.5).tolist())
    if (cells > 0).all():
        end = np.minimum(size, np.maximum(begin + 1, np.round(corner + (skipped + cells) * step).astype(int)))
        crop = image[begin[1] : end[1], begin[0] : end[0]]
        if crop.size:
            inside = _extract_features(crop, cells, begin, np.array(neck), np.array(face), scale)
            features[skipped[1] : skipped[1] + cells[1], skipped[0] : skipped[0] + cells[0]] = inside
    return FeatureWindow(features, origin, step)


def _extract_features(
    crop: U8,
    cells: I64,
    begin: I64,
    neck: F64,
    face: F64,
    scale: float,
) -> F32:
    """Return the features (rows, columns, 36) of a crop that holds `cells` (columns, rows) cells."""
    size = int(cells[0]) * CELL_PX, int(cells[1]) * CELL_PX
    method = cv2.INTER_AREA if crop.shape[1] > size[0] else cv2.INTER_LINEAR
    resized = np.asarray(cv2.resize(crop, size, interpolation=method), np.uint8)
    factor = CELL_PX * CELLS_PER_SCALE / scale
    places = [((at - begin + 0.5) * factor - 0.5) for at in (face, neck + np.array([0.0, CHEST_OFFSET * scale]))]
    features = np.zeros((int(cells[1]), int(cells[0]), DIMENSIONS + COLOUR_CHANNELS), np.float32)
    features[..., :DIMENSIONS] = hog(resized, CELL_PX)
    features[..., DIMENSIONS:] = _colour_features(resized, places, (int(cells[0]), int(cells[1])))
    return features


def _colour_features(image: U8, places: list[F64], cells: tuple[int, int]) -> F32:
    """Return cell means (rows, columns, 4): hue like the face, lightness like it, then both like the chest."""
    coloured = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
    lab = cv2.cvtColor(coloured, cv2.COLOR_RGB2LAB)
    # Hues fill a small part of the a*b* plane, so the resolution around grey is doubled.
    hue = np.clip((lab[..., 1:].astype(np.int32) - 128) // 3 + HUE_BINS // 2, 0, HUE_BINS - 1)
    codes = hue[..., 0] * HUE_BINS + hue[..., 1], lab[..., 0].astype(np.int32) * LIGHT_BINS // 256
    shapes = (HUE_BINS, HUE_BINS), (LIGHT_BINS, 1)
    out = np.zeros((cells[1], cells[0], COLOUR_CHANNELS), np.float32)
    for index, (place, radius) in enumerate(zip(places, (FACE_RADIUS, CHEST_RADIUS), strict=True)):
        mask = np.zeros(image.shape[:2], np.uint8)
        cv2.circle(mask, tuple(np.round(place).astype(int).tolist()), round(radius * CELL_PX * CELLS_PER_SCALE), 1, -1)
        if not mask.any():
            continue
        for kind, (code, shape) in enumerate(zip(codes, shapes, strict=True)):
            ratio = _log_ratio(code, mask.astype(bool), shape)
            means = cv2.resize(ratio[code], cells, interpolation=cv2.INTER_AREA)
            out[..., 2 * index + kind] = means / MAX_LOG_RATIO
    return out


def _log_ratio(code: I32, mask: Bools, shape: tuple[int, int]) -> F32:
    """Return the log ratio of each code's frequency inside the mask to that everywhere, within +-MAX_LOG_RATIO."""
    bins = shape[0] * shape[1]
    inside, whole = (
        _smooth(np.bincount(values, minlength=bins).reshape(shape)) for values in (code[mask], code.ravel())
    )
    ratio: F32 = np.clip(np.log(inside / whole), -MAX_LOG_RATIO, MAX_LOG_RATIO).astype(np.float32).ravel()
    return ratio


def _smooth(counts: I64) -> F64:
    """Return blurred frequencies of the bins, never 0."""
    blurred = cv2.GaussianBlur(counts.astype(np.float64), (5, 5), 1.0, borderType=cv2.BORDER_REPLICATE)
    share: F64 = blurred / blurred.sum() + 0.1 / blurred.size
    return share
