# SPDX-License-Identifier: Apache-2.0
"""Geometry of closed part contours: which way they run, their direction and their outward normal."""

from __future__ import annotations

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F64, Array

FARTHEST = 1e7  # px; coordinates beyond are moved here, where no image is
_REACH = 2  # points on either side that tell the direction of a contour


def checked(contours: Array) -> F64:
    """Contours (P,K,2) as contiguous float64 whose products cannot overflow; what is NaN stays NaN."""
    return np.ascontiguousarray(np.clip(np.asarray(contours, np.float64), -FARTHEST, FARTHEST))


def mirrored_order(contours: Array) -> Array:
    """The points of contours (...,K,2) in the order in which they run on the part of the body's other side."""
    return contours[..., -np.arange(contours.shape[-2]) % contours.shape[-2], :]


def grown(contours: Array, distance: Array) -> F64:
    """Contours (P,K,2) whose points are moved outward by `distance` (P,) px along their normals."""
    moved = checked(contours).copy()
    _grow(checked(contours), np.ascontiguousarray(distance, np.float64), moved)
    return moved


@njit(cache=True, nogil=True)
def winding(contour: Array) -> float:
    """1 for a contour that runs like a right part's in the front view, -1 for a mirrored one, NaN for a broken one.

    With it, the outward normal is `winding * (-t_y, t_x)` where t is the direction.
    """
    area = 0.0
    last = contour.shape[0] - 1
    for k in range(contour.shape[0]):
        area += contour[last, 0] * contour[k, 1] - contour[k, 0] * contour[last, 1]
        last = k
    if not np.isfinite(area):
        return np.nan
    return -1.0 if area > 0.0 else 1.0


@njit(cache=True, nogil=True)
def direction(contour: Array, k: int) -> tuple[float, float]:
    """Unit vector along a contour (K,2) at its point k."""
    count = contour.shape[0]
    a, b = (k + count - _REACH) % count, (k + _REACH) % count
    tx, ty = contour[b, 0] - contour[a, 0], contour[b, 1] - contour[a, 1]
    length = np.sqrt(tx * tx + ty * ty)
    return (tx / length, ty / length) if length > 0.0 else (1.0, 0.0)


@njit(cache=True, nogil=True)
def _grow(contours: Array, distance: Array, moved: Array) -> None:
    for p in range(contours.shape[0]):
        out = distance[p] * winding(contours[p])
        for k in range(contours.shape[1]):
            tx, ty = direction(contours[p], k)
            moved[p, k, 0] = contours[p, k, 0] - out * ty
            moved[p, k, 1] = contours[p, k, 1] + out * tx
