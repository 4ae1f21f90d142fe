# SPDX-License-Identifier: Apache-2.0
"""Affine motions of the parts of many puppets at once, by sums over the regions of their contours.

They are the motions that `flow.affine` fits to one puppet's visible pixels, without its iterations: the least squares
of a region need twelve sums, which prefix sums along the rows give for any contour. What the iterations do there is
done once for all puppets here: a pixel weighs less where the flow does not return, or is that of the background.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F32, F64
from flowing_puppet_ros.flow.affine import (
    BACKGROUND_WEIGHT,
    LINEAR_PRIOR_SD,
    MIN_TRANSLATION_SAMPLES,
    PIXELS_PER_OBSERVATION,
    fit_regions,
    round_trip_weight,
)
from flowing_puppet_ros.flow.estimate import FlowPair
from flowing_puppet_ros.image.tracking.propagation import ImageScale

SUMS = 12
"""Sums over weights w: w times 1, x, y, xx, xy, yy, then w times u, v, ux, uy, vx, vy."""


@dataclass(frozen=True, slots=True, eq=False)
class FlowMoments:
    """Sums of one flow field around a person: `along` (h, w+1, 12) from pixel `corner` (x, y) of the flow's grid on."""

    along: F64
    corner: F64
    grid: ImageScale

    @classmethod
    def of(cls, flow: FlowPair, grid: ImageScale, low: F64, high: F64) -> Self:
        """Sum the `flow` (there, back) on the working grid, within image pixels `low` to `high` (2,)."""
        first = np.clip(np.floor(grid.to_work(low)), 0, np.array(grid.work) - 1).astype(int)
        last = np.clip(np.ceil(grid.to_work(high)), first + 1, grid.work).astype(int)
        there, back = (np.ascontiguousarray(field, np.float32) for field in flow)
        background = fit_regions(np.zeros(there.shape[:2], np.uint16), 1, there, back).affine[0]
        return cls(_prepare(there, back, background, *first, *last), first.astype(np.float64), grid)

    def fit_affine(self, contours: F64) -> tuple[F64, F64]:
        """Fit the motions (P, 2, 3) of regions with `contours` (P, K, 2) px of the image; return them and weights (P,).

        Regions of little weight stay where they are.
        """
        local = np.ascontiguousarray(self.grid.to_work(contours) - self.corner, np.float64)
        sums = np.zeros((len(contours), SUMS))
        _gather(self.along, local, sums)
        weight = np.maximum(sums[:, 0], 1e-9)
        mean = sums[:, 1:3] / weight[:, None]
        spread = np.empty((len(contours), 2, 2))
        spread[:, 0, 0] = sums[:, 3] - weight * mean[:, 0] ** 2
        spread[:, 1, 1] = sums[:, 5] - weight * mean[:, 1] ** 2
        spread[:, 0, 1] = spread[:, 1, 0] = sums[:, 4] - weight * mean[:, 0] * mean[:, 1]
        flow = sums[:, 6:8] / weight[:, None]
        cross = sums[:, 8:12].reshape(-1, 2, 2) - weight[:, None, None] * flow[:, :, None] * mean[:, None, :]
        stiff = PIXELS_PER_OBSERVATION / LINEAR_PRIOR_SD**2 * np.eye(2)
        linear = np.linalg.solve(spread + stiff, np.swapaxes(cross, 1, 2)).swapaxes(1, 2)
        known = weight >= MIN_TRANSLATION_SAMPLES
        linear[~known], flow[~known] = 0.0, 0.0
        return self._to_image_motion(linear, flow, mean), np.where(known, weight, 0.0)

    def _to_image_motion(self, linear: F64, flow: F64, mean: F64) -> F64:
        """Convert motions of the grid around `mean`, relative to the corner, to motions of the image."""
        center = self.grid.to_image(mean + self.corner)
        ratio = self.grid.factor
        matrix = linear * ratio[None, None, :] / ratio[None, :, None] + np.eye(2)
        shift = flow / ratio + center - np.einsum("pij,pj->pi", matrix, center)
        return np.concatenate([matrix, shift[:, :, None]], axis=2)


@njit(cache=True, nogil=True)
def _prepare(
    there: F32, back: F32, background: F64, left: int, top: int, right: int,
    bottom: int,
) -> F64:  # fmt: skip
    along = np.zeros((bottom - top, right - left + 1, 12))
    a = background
    for y in range(bottom - top):
        for x in range(right - left):
            for k in range(12):
                along[y, x + 1, k] = along[y, x, k]
            u, v = float(there[y + top, x + left, 0]), float(there[y + top, x + left, 1])
            if not (np.isfinite(u) and np.isfinite(v)):
                continue
            at_x, at_y = x + left, y + top
            misfit_x = a[0, 0] * at_x + a[0, 1] * at_y + a[0, 2] - at_x - u
            misfit_y = a[1, 0] * at_x + a[1, 1] * at_y + a[1, 2] - at_y - v
            square = misfit_x * misfit_x + misfit_y * misfit_y
            w = round_trip_weight(at_x, at_y, u, v, back) * (BACKGROUND_WEIGHT + square) / (1.0 + square)
            sums = along[y, x + 1]
            sums[0] += w
            sums[1] += w * x
            sums[2] += w * y
            sums[3] += w * x * x
            sums[4] += w * x * y
            sums[5] += w * y * y
            sums[6] += w * u
            sums[7] += w * v
            sums[8] += w * u * x
            sums[9] += w * u * y
            sums[10] += w * v * x
            sums[11] += w * v * y
    return along


@njit(cache=True, nogil=True)
def _gather(along: F64, contours: F64, sums: F64) -> None:
    """Green's theorem by rows, see `evidence.image.region`."""
    height, width = along.shape[0], along.shape[1] - 1
    for p in range(contours.shape[0]):
        area = 0.0
        last = contours.shape[1] - 1
        for k in range(contours.shape[1]):
            x0, y0, x1, y1 = contours[p, last, 0], contours[p, last, 1], contours[p, k, 0], contours[p, k, 1]
            last = k
            if not np.isfinite(x0 + y0 + x1 + y1):
                sums[p] = 0.0
                break
            sign = 1.0 if y1 > y0 else -1.0
            low, high = min(y0, y1), max(y0, y1)
            first, end = int(np.ceil(min(max(low, 0.0), height))), int(np.ceil(min(max(high, 0.0), height)))
            for row in range(first, end):
                crossing = x0 + (row - y0) / (y1 - y0) * (x1 - x0)
                left = int(np.ceil(min(max(crossing, 0.0), width)))
                area += sign * left
                for m in range(12):
                    sums[p, m] += sign * along[row, left, m]
        if area < 0.0:
            for m in range(12):
                sums[p, m] = -sums[p, m]
