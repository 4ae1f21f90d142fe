# SPDX-License-Identifier: Apache-2.0
"""Means of a map over the regions that contours enclose, from sums along the map's rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F64, Array
from flowing_puppet_ros.evidence.image.outline import clip_coordinates


@dataclass(frozen=True, slots=True, eq=False)
class RegionMap:
    """A map over the image, prepared for sums over regions: `values` (H, W), `along` (H, W+1) sums of its rows."""

    values: F64
    along: F64

    @classmethod
    def of(cls, values: Array) -> RegionMap:
        """Prepare a map `values` (H, W)."""
        values = np.ascontiguousarray(values, np.float64)
        return cls(values, np.pad(np.cumsum(values, axis=1), ((0, 0), (1, 0))))

    def sums(self, contours: Array) -> tuple[F64, F64]:
        """Sum the map over the pixels with centres inside closed `contours` (P, K, 2) px.

        Returns the sums (P,) and the numbers of pixels (P,); NaN where a contour is not finite.
        """
        total, area = np.zeros(len(contours)), np.zeros(len(contours))
        _sums(self.along, clip_coordinates(contours), total, area)
        return total, area

    def mean(self, contours: Array) -> F64:
        """Average the map over the regions of `contours` (P, K, 2) px: 0 outside the image, NaN where not finite."""
        return ratio(*self.sums(contours))


def ratio(total: Array, count: Array) -> F64:
    """Divide sums by counts; 0 where the count is 0."""
    return np.where(count == 0.0, 0.0, total / np.where(count == 0.0, 1.0, count))


@njit(cache=True, nogil=True)
def _sums(along: Array, contours: Array, total: Array, area: Array) -> None:
    """Sum by Green's theorem, row by row: every edge adds, with its sign, what lies to the left of its crossing."""
    height, width = along.shape[0], along.shape[1] - 1
    for p in range(contours.shape[0]):
        last = contours.shape[1] - 1
        for k in range(contours.shape[1]):
            x0, y0, x1, y1 = contours[p, last, 0], contours[p, last, 1], contours[p, k, 0], contours[p, k, 1]
            last = k
            if np.isnan(x0 + y0 + x1 + y1):
                total[p] = area[p] = np.nan
                break
            sign = 1.0 if y1 > y0 else -1.0
            low, high = min(y0, y1), max(y0, y1)
            first, end = int(np.ceil(min(max(low, 0.0), height))), int(np.ceil(min(max(high, 0.0), height)))
            for row in range(first, end):
                crossing = x0 + (row - y0) / (y1 - y0) * (x1 - x0)
                left = int(np.ceil(min(max(crossing, 0.0), width)))
                total[p] += sign * along[row, left]
                area[p] += sign * left
        if area[p] < 0.0:
            total[p], area[p] = -total[p], -area[p]
