# SPDX-License-Identifier: Apache-2.0
"""Where a person is in an image, pixel by pixel, as a segmentation network says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64, I64, U8, Array, Flow

INSIDE = 128
"""Least value of a cell that is the person's."""
EDGE_CELLS, REACH_CELLS = 5, 21
"""Sides of the squares by which a mask is narrowed where its flow is measured, and over which that is averaged."""

CARRIED_PX, CARRIED_SHARE = 0.5, 0.25
"""By which a carried mask may be off, in pixels and as a share of how far it has moved."""
EXACT_CELLS = 8
"""Beside a mask, within which distances from it are exact."""


@dataclass(frozen=True, slots=True, eq=False)
class PersonMask:
    """How surely each cell of a grid shows a person.

    Attributes:
        values: (h, w) uint8, 255 for sure. What is outside of the grid is not the person.
        to_image: (2, 3) leads from the grid's columns and rows to the image's pixels; the grid may be turned.
        slack: pixels by which the person may have moved since.
    """

    values: U8
    to_image: F64
    slack: float = 0.0

    @classmethod
    def of_grid(cls, values: U8, image_size: tuple[int, int]) -> PersonMask:
        """Return a mask whose `values` (h, w) cover an image of `image_size` (width, height)."""
        across, down = image_size[0] / values.shape[1], image_size[1] / values.shape[0]
        return cls(values, np.array([[across, 0, 0.5 * across - 0.5], [0, down, 0.5 * down - 0.5]]))

    @property
    def cell(self) -> float:
        """Side of a cell in pixels of the image."""
        return float(np.sqrt(abs(np.linalg.det(self.to_image[:, :2]))))

    @property
    def area(self) -> float:
        """Area in square pixels of the image."""
        return float(np.count_nonzero(self.values >= INSIDE)) * self.cell**2

    def find_near(self, pixels: F64, margin: float) -> I64:
        """Return the rows of the `pixels` (N, 2) that may be within a `margin`, in pixels, from the person."""
        rows, columns = _find_box(self.values >= INSIDE, 0)
        corners = np.array([(x, y) for x in (columns.start, columns.stop) for y in (rows.start, rows.stop)]) - 0.5
        places = corners @ self.to_image[:, :2].T + self.to_image[:, 2]
        (left, top), (right, bottom) = places.min(axis=0) - margin, places.max(axis=0) + margin
        x, y = pixels[:, 0], pixels[:, 1]
        with np.errstate(invalid="ignore"):
            return np.flatnonzero((x >= left) & (x <= right) & (y >= top) & (y <= bottom))

    def draw(self, size: tuple[int, int], image_size: tuple[int, int]) -> U8:
        """Return the values (h, w) on a grid of `size` (width, height) that covers an image of `image_size`."""
        across, down = size[0] / image_size[0], size[1] / image_size[1]
        to_grid = np.array([[across, 0, 0.5 * across - 0.5], [0, down, 0.5 * down - 0.5]])
        matrix = to_grid @ _square(self.to_image)
        return np.asarray(cv2.warpAffine(self.values, matrix, size))

    def carry(self, forward: Flow, image_size: tuple[int, int]) -> PersonMask:
        """Return the mask in the next image, moved by the flow within it.

        At its edge the flow is partly that of the background, so the edge moves with what is inside of it.

        Args:
            forward: (h, w, 2) from each cell of the image to where it is in the next one, in cells, NaN where unknown.
            image_size: (width, height) of both images.
        """
        height, width = forward.shape[:2]
        values = self.draw((width, height), image_size)
        place = _find_box(values, REACH_CELLS)
        near, flow = values[place], forward[place]
        core = cv2.erode((near >= INSIDE).astype(np.uint8), np.ones((EDGE_CELLS, EDGE_CELLS), np.uint8))
        weight = np.where(np.isfinite(flow).all(axis=2), core, 0).astype(np.float32)
        total = cv2.blur(weight, (REACH_CELLS, REACH_CELLS))
        step = cv2.blur(np.where(weight[..., None] > 0, flow, 0).astype(np.float32), (REACH_CELLS, REACH_CELLS))
        step /= np.maximum(total, 1e-6)[..., None]
        row, column = np.indices(near.shape, dtype=np.float32)
        moved = np.zeros_like(values)
        moved[place] = cv2.remap(near, column - step[..., 0], row - step[..., 1], cv2.INTER_LINEAR)
        made = PersonMask.of_grid(moved, image_size)
        inner = step[weight > 0]
        far = float(np.median(np.hypot(inner[:, 0], inner[:, 1]))) * made.cell if len(inner) else 0.0
        return replace(made, slack=self.slack + CARRIED_PX + CARRIED_SHARE * far)

    def move(self, step: F64, slack: float) -> PersonMask:
        """Return the mask of a person who has moved by `step` (2,) px, and in places by up to `slack` px more."""
        to_image = self.to_image.copy()
        to_image[:, 2] += step
        return PersonMask(self.values, to_image, self.slack + slack)

    def measure_distance(self, pixels: F64) -> F64:
        """Return how far `pixels` (N, 2) of the image are outside of the person, (N,) px, negative inside.

        Far outside it is at least so far. NaN for pixels that are NaN, infinite where the mask is empty.
        """
        inside = self.values >= INSIDE
        if not inside.any():
            return np.full(len(pixels), np.inf)
        place = _find_box(inside, EXACT_CELLS)
        shown = inside[place].astype(np.uint8)
        away = cv2.distanceTransform(1 - shown, cv2.DIST_L2, cv2.DIST_MASK_5)
        away -= cv2.distanceTransform(shown, cv2.DIST_L2, cv2.DIST_MASK_5)
        known = np.isfinite(pixels).all(axis=1)
        to_grid = np.linalg.inv(_square(self.to_image))[:2]
        x, y = to_grid[:, :2] @ pixels[known].T + to_grid[:, 2:] - np.array([[place[1].start], [place[0].start]])
        column, row = np.clip(np.rint(x), 0, shown.shape[1] - 1), np.clip(np.rint(y), 0, shown.shape[0] - 1)
        beyond = np.hypot(np.maximum(np.abs(x - column) - 0.5, 0.0), np.maximum(np.abs(y - row) - 0.5, 0.0))
        distance = np.full(len(pixels), np.nan)
        distance[known] = (away[row.astype(np.int64), column.astype(np.int64)] + beyond) * self.cell
        return distance


def label_people(masks: Sequence[PersonMask | None], size: tuple[int, int], image_size: tuple[int, int]) -> U8:
    """Return a label image (h, w) of `size` (width, height): 0 is nobody, k + 1 whom the k-th mask shows surest.

    Masks are as wide as their slack lets them be.
    """
    labels, best = np.zeros(size[::-1], dtype=np.uint8), np.full(size[::-1], INSIDE - 1, dtype=np.uint8)
    for number, mask in enumerate(masks[:255]):
        if mask is not None:
            values = _widen(mask.draw(size, image_size), mask.slack * size[0] / image_size[0])
            labels[values > best] = number + 1
            best = np.maximum(best, values)
    return labels


def _widen(values: U8, cells: float) -> U8:
    """Return values (h, w) widened by so many cells: what may be the person's is not somebody else's."""
    if round(cells) < 1:
        return values
    side = 2 * round(cells) + 1
    return np.asarray(cv2.dilate(values, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))))


def _find_box(values: Array, margin: int) -> tuple[slice, slice]:
    """Return the rows and columns of the box about all values (h, w) that are not 0, with a margin."""
    found = []
    for axis in (1, 0):
        places = np.flatnonzero(values.any(axis=axis))
        first, last = (int(places[0]), int(places[-1])) if len(places) else (0, 0)
        found.append(slice(max(first - margin, 0), last + 1 + margin))
    return found[0], found[1]


def _square(matrix: F64) -> F64:
    return np.vstack([matrix, [0.0, 0.0, 1.0]])
