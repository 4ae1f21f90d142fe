# SPDX-License-Identifier: Apache-2.0
"""Places of heads and of the densest upper bodies in a cluster, about which it is cut into columns."""

from __future__ import annotations

import numpy as np
from numba import njit

MIN_UPPER_M, MODE_WIDTH_M = 0.9, 0.28  # height of upper bodies, and width of the window of their densest columns
PEAK_CELL_M, PEAK_RADIUS_CELLS = 0.1, 2
MIN_PEAK_GAP_M = 0.3  # between two columns
MIN_DENSITY = 0.2  # of a densest column: the roots of its cells' points, averaged over the window
_MARGIN_CELLS = 5  # about the cluster
_KERNEL_CELLS = 6  # on either side of the window's middle, four of its deviations


def find_columns(points: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return places (K, 2) m of heads, the highest first, and of upper bodies that are below none of them.

    Args:
        points: (M, 3) of a cluster: x, y and height over the floor, metres.
        weight: (M,) number of points that each stands for.
    """
    upper = points[:, 2] > MIN_UPPER_M
    if not upper.any():
        return np.empty((0, 2))
    cells = np.arange(-_KERNEL_CELLS, _KERNEL_CELLS + 1)
    kernel = np.exp(-0.5 * (cells * PEAK_CELL_M / (MODE_WIDTH_M / 2)) ** 2)
    return _find_peaks(points[upper], np.sqrt(weight[upper]), kernel / kernel.sum())


@njit(cache=True, nogil=True)
def find_nearest_column(points, columns, radius):  # type: ignore[no-untyped-def]
    """Return the nearest (M,) of the columns (K, 2) m to points (M, 3) m; -1 for none within a radius."""
    owner = np.full(len(points), -1, np.int64)
    for row in range(len(points)):
        best = radius * radius
        for k in range(len(columns)):
            x, y = points[row, 0] - columns[k, 0], points[row, 1] - columns[k, 1]
            if x * x + y * y < best:
                owner[row], best = k, x * x + y * y
    return owner


@njit(cache=True, nogil=True)
def _find_peaks(points, weight, kernel):  # type: ignore[no-untyped-def]
    left = points[:, 0].min() - _MARGIN_CELLS * PEAK_CELL_M
    low = points[:, 1].min() - _MARGIN_CELLS * PEAK_CELL_M
    wide = int((points[:, 0].max() - left) / PEAK_CELL_M) + _MARGIN_CELLS + 1
    deep = int((points[:, 1].max() - low) / PEAK_CELL_M) + _MARGIN_CELLS + 1
    tops, density = np.zeros((wide, deep)), np.zeros((wide, deep))
    for k in range(len(points)):
        i, j = int((points[k, 0] - left) / PEAK_CELL_M), int((points[k, 1] - low) / PEAK_CELL_M)
        tops[i, j] = max(tops[i, j], points[k, 2])
        density[i, j] += weight[k]
    density = _blur(density, kernel)
    heads, head_tops, modes = [(0, 0)], [0.0], [(0, 0)]
    for i in range(wide):
        for j in range(deep):
            if tops[i, j] > 0 and _is_peak(tops, i, j, 1e-9):
                heads.append((i, j))
                head_tops.append(tops[i, j])
            if density[i, j] > MIN_DENSITY and _is_peak(density, i, j, 1e-12):
                modes.append((i, j))
    order = np.argsort(-np.array(head_tops[1:]), kind="mergesort")
    kept, count = np.empty((len(heads) + len(modes), 2)), 0
    for k in range(len(order) + len(modes) - 1):
        i, j = heads[1 + order[k]] if k < len(order) else modes[1 + k - len(order)]
        x, y = left + PEAK_CELL_M * (i + 0.5), low + PEAK_CELL_M * (j + 0.5)
        free = True
        for other in range(count):
            free &= np.hypot(x - kept[other, 0], y - kept[other, 1]) > MIN_PEAK_GAP_M
        if free:
            kept[count, 0], kept[count, 1] = x, y
            count += 1
    return kept[:count].copy()


@njit(cache=True, nogil=True)
def _is_peak(image, i, j, slack):  # type: ignore[no-untyped-def]
    """Return whether no cell of the window about a cell is higher."""
    for a in range(max(i - PEAK_RADIUS_CELLS, 0), min(i + PEAK_RADIUS_CELLS + 1, image.shape[0])):
        for b in range(max(j - PEAK_RADIUS_CELLS, 0), min(j + PEAK_RADIUS_CELLS + 1, image.shape[1])):
            if image[a, b] > image[i, j] + slack:
                return False
    return True


@njit(cache=True, nogil=True)
def _blur(image, kernel):  # type: ignore[no-untyped-def]
    """Blur along both axes; most of an image is empty, so its cells are spread, not gathered."""
    half = len(kernel) // 2
    for axis in range(2):
        wide, deep = image.shape
        spread = np.zeros_like(image)
        for i in range(wide):
            for j in range(deep):
                if image[i, j] > 0:
                    at, size = (i, wide) if axis == 0 else (j, deep)
                    for k in range(max(at - half, 0), min(at + half + 1, size)):
                        if axis == 0:
                            spread[k, j] += image[i, j] * kernel[k - at + half]
                        else:
                            spread[i, k] += image[i, j] * kernel[k - at + half]
        image = spread
    return image
