# SPDX-License-Identifier: Apache-2.0
"""The rays of a whole scan: what hides a candidate from the sensor, and where the sensor did not look."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numba import njit

BINS = 360  # of azimuth, in which the lowest ray is looked up
HIDING_DISTANCE_M = 0.3  # in front of a candidate, from which on something else hides what is behind it
WINDOW_M = (0.9, 0.9)  # to either side of a candidate, and above and below it
UNKNOWN_STEP_RAD, UNKNOWN_STEP_M = np.radians(0.5), 0.04  # between places without rays, whichever is larger
MAX_HIDING_POINTS = 3000
MIN_CELL_RAD, CELL_M = np.radians(0.15), 0.025  # of the image of a body as the sensor would see it
OUTLINE_CELLS, OUTLINE_M = 6, 0.25
"""Cells to either side of a body, and distance behind it, in which rays that pass it show its outline."""
BAND_EDGES = (0.45, 0.8)  # shares of a body's height at which legs, trunk, and head and shoulders meet
BANDS = len(BAND_EDGES) + 1
SUPPORT_M = 0.12  # between a body and the end of a ray that confirms it


class RayCount(NamedTuple):
    """Numbers (BANDS,) of rays by where they end, for the legs, the trunk, and head and shoulders of a body.

    `on` the body, `behind` it though it is in the way, `before` it; and of those that pass `beside` it, to its left and
    right, the `free` ones, which end behind it.
    """

    on: np.ndarray
    behind: np.ndarray
    before: np.ndarray
    free: np.ndarray
    beside: np.ndarray


@dataclass(frozen=True, eq=False)
class ScanRays:
    """The rays of a scan as seen from its sensor; their directions are computed when they are first asked for.

    Attributes:
        points: (N, 3) metres, N > 0, finite.
        viewpoint: (3,) metres.
    """

    points: np.ndarray
    viewpoint: np.ndarray

    @property
    def azimuth(self) -> np.ndarray:
        """Azimuth (N,) radians."""
        return self._directions[0]

    @property
    def elevation(self) -> np.ndarray:
        """Elevation (N,) radians."""
        return self._directions[1]

    @property
    def range(self) -> np.ndarray:
        """Range (N,) metres."""
        return self._directions[2]

    @cached_property
    def lowest(self) -> np.ndarray:
        """Elevation (BINS,) radians of the lowest ray by azimuth, NaN where there is none."""
        lowest = np.full(BINS, np.inf)
        np.minimum.at(lowest, _bin_of(self.azimuth), self.elevation)
        lowest[np.isinf(lowest)] = np.nan
        return lowest

    @cached_property
    def highest(self) -> float:
        """Elevation of the highest ray, radians."""
        return float(self.elevation.max())

    @cached_property
    def _directions(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        local = self.points - self.viewpoint
        flat = np.hypot(local[:, 0], local[:, 1])
        azimuth, elevation = np.arctan2(local[:, 1], local[:, 0]), np.arctan2(local[:, 2], flat)
        return azimuth, elevation, np.hypot(flat, local[:, 2])

    def find_window(self, points: np.ndarray) -> np.ndarray:
        """Return the indices (M,) of the rays around a candidate with points (K, 3) m."""
        local = points - self.viewpoint
        away = max(float(np.hypot(local[:, 0], local[:, 1]).min()), 0.3)
        middle = float(np.arctan2(local[:, 1].mean(), local[:, 0].mean()))
        turn = np.abs((self.azimuth - middle + np.pi) % (2 * np.pi) - np.pi)
        low, high = self._limit_elevation(points, away)
        return np.flatnonzero((turn < np.arctan(WINDOW_M[0] / away)) & (self.elevation > low) & (self.elevation < high))

    def find_unknown(self, points: np.ndarray, window: np.ndarray) -> np.ndarray:
        """Return places (K, 3) m in whose directions nothing is known about a candidate with points (N, 3) m.

        These are what stands in front of it, and directions below, beside and above all rays of the scan.
        """
        own = np.linalg.norm(points - self.viewpoint, axis=1)
        hiding = window[self.range[window] < np.percentile(own, 5) - HIDING_DISTANCE_M]
        hiding = hiding[:: 1 + len(hiding) // MAX_HIDING_POINTS]
        return np.concatenate([self.points[hiding], self._find_unscanned(points)])

    def _find_unscanned(self, points: np.ndarray) -> np.ndarray:
        local = points - self.viewpoint
        away = max(float(np.hypot(local[:, 0], local[:, 1]).min()), 0.3)
        middle, half = float(np.arctan2(local[:, 1].mean(), local[:, 0].mean())), np.arctan(WINDOW_M[0] / away)
        low, high = self._limit_elevation(points, away)
        step = max(UNKNOWN_STEP_RAD, UNKNOWN_STEP_M / away)
        azimuth = middle + np.arange(-half, half, step)
        elevation = np.arange(low, high, step)
        a, e = (grid.ravel() for grid in np.meshgrid(azimuth, elevation, indexing="ij"))
        lowest = self.lowest[_bin_of(a)]
        outside = np.isnan(lowest) | (e < lowest - step) | (e > self.highest + step)
        a, e = a[outside], e[outside]
        return self.viewpoint + np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)

    def _limit_elevation(self, points: np.ndarray, away: float) -> tuple[float, float]:
        z = points[:, 2] - self.viewpoint[2]
        return (
            float(np.arctan2(z.min() - 2 * WINDOW_M[1], away)),
            float(np.arctan2(z.max() + WINDOW_M[1], away)),
        )

    def compare(self, window: np.ndarray, vertices: np.ndarray, normals: np.ndarray) -> RayCount:
        """Count the rays that end on a body, behind it though it is in the way, in front of it, and beside it.

        Args:
            window: (M,) rays around the body.
            vertices: (V, 3) m of the body.
            normals: (V, 3).
        """
        facing = ((self.viewpoint - vertices) * normals).sum(axis=1) > 0
        local = vertices[facing] - self.viewpoint
        reach = np.linalg.norm(local, axis=1)
        if not len(local):
            return RayCount(*np.zeros((5, BANDS), np.int64))
        middle = float(np.arctan2(local[:, 1].mean(), local[:, 0].mean()))
        azimuth = (np.arctan2(local[:, 1], local[:, 0]) - middle + np.pi) % (2 * np.pi) - np.pi
        elevation = np.arctan2(local[:, 2], np.hypot(local[:, 0], local[:, 1]))
        ray_azimuth = (self.azimuth[window] - middle + np.pi) % (2 * np.pi) - np.pi
        cell = max(MIN_CELL_RAD, CELL_M / float(np.median(reach)))
        own = self.elevation[window], self.range[window]
        share = (vertices[facing, 2] - vertices[:, 2].min()) / max(float(np.ptp(vertices[:, 2])), 1e-6)
        band = np.searchsorted(BAND_EDGES, share)
        return RayCount(*_compare_rays(azimuth, elevation, reach, band, ray_azimuth, *own, cell))


def _bin_of(azimuth: np.ndarray) -> np.ndarray:
    return np.floor((azimuth + np.pi) / (2 * np.pi) * BINS).astype(np.int64) % BINS


@njit(cache=True, nogil=True)
def _compare_rays(azimuth, elevation, reach, band, ray_azimuth, ray_elevation, ray_range, cell):  # type: ignore[no-untyped-def]
    """Draw a body's facing vertices into an image of ranges and look the rays up in it; see `RayCount`."""
    left, low = azimuth.min(), elevation.min()
    width, height = int((azimuth.max() - left) / cell) + 1, int((elevation.max() - low) / cell) + 1
    image, bands, row_bands = np.full((width, height), np.inf), np.zeros((width, height), np.int64), np.zeros(height)
    for k in range(len(azimuth)):
        i, j = int((azimuth[k] - left) / cell), int((elevation[k] - low) / cell)
        if reach[k] < image[i, j]:
            image[i, j], bands[i, j] = reach[k], band[k]
    first, last, nearest = np.full(height, width), np.full(height, -1), np.full(height, np.inf)
    for i in range(width):
        for j in range(height):
            if image[i, j] < np.inf:
                first[j], last[j] = min(first[j], i), max(last[j], i)
                if image[i, j] < nearest[j]:
                    nearest[j], row_bands[j] = image[i, j], bands[i, j]
    count = np.zeros((5, BANDS), np.int64)
    for k in range(len(ray_azimuth)):
        i, j = int(np.floor((ray_azimuth[k] - left) / cell)), int(np.floor((ray_elevation[k] - low) / cell))
        if j < 0 or j >= height:
            continue
        if last[j] < i <= last[j] + OUTLINE_CELLS or first[j] - OUTLINE_CELLS <= i < first[j]:
            count[3, int(row_bands[j])] += ray_range[k] > nearest[j] + OUTLINE_M
            count[4, int(row_bands[j])] += 1
        if i < 0 or i >= width or np.isinf(image[i, j]):
            continue
        gap = ray_range[k] - image[i, j]
        count[1 if gap > SUPPORT_M else 2 if gap < -SUPPORT_M else 0, bands[i, j]] += 1
    return count
