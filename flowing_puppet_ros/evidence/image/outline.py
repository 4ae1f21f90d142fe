# SPDX-License-Identifier: Apache-2.0
"""Geometry of closed part contours: winding, direction and outward normal."""

from __future__ import annotations

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F64, Array

MAX_COORDINATE_PX = 1e7  # coordinates are clipped here, far outside of any image
_DIRECTION_STEP = 2  # points on either side from which the direction of a contour is computed


def clip_coordinates(contours: Array) -> F64:
    """Return contours (P, K, 2) as contiguous float64 whose products cannot overflow; NaN stays NaN."""
    return np.ascontiguousarray(np.clip(np.asarray(contours, np.float64), -MAX_COORDINATE_PX, MAX_COORDINATE_PX))


def mirror_order(contours: Array) -> Array:
    """Return the points of contours (..., K, 2) in the order of the part on the body's other side."""
    return contours[..., -np.arange(contours.shape[-2]) % contours.shape[-2], :]


def grow(contours: Array, distance: Array) -> F64:
    """Move the points of contours (P, K, 2) outward by `distance` (P,) px along their normals."""
    moved = clip_coordinates(contours).copy()
    _grow(clip_coordinates(contours), np.ascontiguousarray(distance, np.float64), moved)
    return moved


@njit(cache=True, nogil=True)
def winding(contour: Array) -> float:
    """Return 1 for a contour that runs like a right part's in the front view, -1 for a mirrored one, NaN if not finite.

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
    """Return the unit vector along a contour (K, 2) at its point `k`."""
    count = contour.shape[0]
    a, b = (k + count - _DIRECTION_STEP) % count, (k + _DIRECTION_STEP) % count
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
