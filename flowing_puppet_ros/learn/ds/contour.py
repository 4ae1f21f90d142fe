# SPDX-License-Identifier: Apache-2.0
"""Outlines of projected body parts: mesh -> filled silhouette -> closed contour -> each side of the bone resampled.

Thesis, chapter "Deformable Structure Model", section "Learning".
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F64, I32, U8

PIXELS_PER_METRE = 500.0
"""Resolution at which silhouettes are drawn: 2 mm per pixel."""

_SMOOTHING_PX = 2.0  # deviation of the Gaussian along the contour
_MAX_CLEFT_M = 0.025  # width of clefts that are filled


@njit(cache=True, nogil=True)
def _fill(points: F64, triangles: I32, mask: U8) -> None:
    height, width = mask.shape
    for face in range(triangles.shape[0]):
        a, b, c = points[triangles[face, 0]], points[triangles[face, 1]], points[triangles[face, 2]]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0.0:
            continue
        sign = 1.0 if area > 0.0 else -1.0
        top = max(0, int(np.ceil(min(a[1], b[1], c[1]))))
        bottom = min(height - 1, int(np.floor(max(a[1], b[1], c[1]))))
        left = max(0, int(np.ceil(min(a[0], b[0], c[0]))))
        right = min(width - 1, int(np.floor(max(a[0], b[0], c[0]))))
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                if (
                    sign * ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) >= 0.0
                    and sign * ((c[0] - b[0]) * (y - b[1]) - (c[1] - b[1]) * (x - b[0])) >= 0.0
                    and sign * ((a[0] - c[0]) * (y - c[1]) - (a[1] - c[1]) * (x - c[0])) >= 0.0
                ):
                    mask[y, x] = 1


def fill_silhouette(points: F64, triangles: I32, shape: tuple[int, int]) -> U8:
    """Rasterise projected triangles `triangles` (F, 3) of `points` (V, 2) px, whichever way they face.

    Return a mask (H, W) uint8 of size `shape`: 1 where a pixel's centre is covered, edges included.
    """
    mask = np.zeros(shape, np.uint8)
    _fill(np.ascontiguousarray(points, np.float64), np.ascontiguousarray(triangles, np.int32), mask)
    return mask


def trace_contour(points: F64, triangles: I32, resolution: float = PIXELS_PER_METRE) -> F64:
    """Return the outer contour of the largest piece of the silhouette of a projected part mesh.

    Clefts narrower than 25 mm, as between fingers, are filled, because they would dominate the arc length.

    Args:
        points: (V, 2) m, of which only those in `triangles` count.
        triangles: (F, 3).
        resolution: pixels per metre.

    Returns:
        (K, 2) m, closed (the last point is joined to the first), without the steps of the pixel grid.

    Raises:
        ValueError: if the projection covers nothing.
    """
    used = points[np.unique(triangles)]
    cleft = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * int(_MAX_CLEFT_M * resolution / 2) + 1,) * 2)
    margin = len(cleft) + 2
    origin = used.min(axis=0) - margin / resolution
    width, height = np.ceil((used.max(axis=0) - origin) * resolution).astype(int) + margin
    mask = fill_silhouette((points - origin) * resolution, triangles, (height, width))
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, cleft)
    pieces, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not pieces or max(map(len, pieces)) < 8:
        raise ValueError(f"a part of {len(triangles)} faces covers no area in the projection")
    piece = max(pieces, key=cv2.contourArea)[:, 0, :].astype(np.float64)
    return _smooth(piece) / resolution + origin


def _smooth(closed: F64) -> F64:
    """Smooth a closed chain of pixels by a circular Gaussian filter."""
    reach = int(3 * _SMOOTHING_PX)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / _SMOOTHING_PX) ** 2)
    kernel /= kernel.sum()
    padded = np.take(closed, np.arange(-reach, len(closed) + reach), axis=0, mode="wrap")
    return np.stack([np.convolve(padded[:, axis], kernel, "valid") for axis in (0, 1)], axis=1)


def resample_sides(contour: F64, proximal: F64, distal: F64, per_side: int) -> F64:
    """Divide a closed contour by the line through the bone and sample each side evenly by arc length.

    Args:
        contour: (K, 2).
        proximal: (2,) bone end.
        distal: (2,) bone end.
        per_side: points per side.

    Returns:
        (2 * per_side, 2) in the part's frame (origin in the middle of the bone, x from proximal to distal, y a quarter
        turn from x, in the sense from image x to image y). Row 0 is the farthest crossing of the bone line behind the
        proximal joint; the side of positive y comes first; row `per_side` is the farthest crossing beyond the distal
        joint.

    Raises:
        ValueError: if the bone line misses the contour.
    """
    local = to_bone_frame(contour, proximal, distal)
    following = np.roll(local, -1, axis=0)
    crossing = np.flatnonzero((local[:, 1] >= 0.0) != (following[:, 1] >= 0.0))
    if len(crossing) < 2:
        raise ValueError("the line through the bone does not cross the part's contour")
    share = local[crossing, 1] / (local[crossing, 1] - following[crossing, 1])
    abscissa = local[crossing, 0] + share * (following[crossing, 0] - local[crossing, 0])
    first, last = int(np.argmin(abscissa)), int(np.argmax(abscissa))
    there = _cut_arc(local, crossing[first], crossing[last], abscissa[first], abscissa[last])
    back = _cut_arc(local, crossing[last], crossing[first], abscissa[last], abscissa[first])
    if there[:, 1].mean() < back[:, 1].mean():
        there, back = back[::-1], there[::-1]
    return np.concatenate([_resample_evenly(there, per_side), _resample_evenly(back, per_side)])


def to_bone_frame(points: F64, proximal: F64, distal: F64) -> F64:
    """Express (K, 2) points in the frame with its origin in the middle of the bone and x from proximal to distal."""
    axis = distal - proximal
    axis = axis / np.hypot(*axis)
    moved = points - 0.5 * (proximal + distal)
    return np.stack([moved @ axis, moved @ np.array([-axis[1], axis[0]])], axis=1)


def _cut_arc(closed: F64, start: int, end: int, start_x: float, end_x: float) -> F64:
    """Return the points of a closed contour from the crossing after `start` to the crossing after `end`."""
    count = (end - start) % len(closed)
    inner = np.take(closed, np.arange(start + 1, start + 1 + count), axis=0, mode="wrap")
    return np.concatenate([[[start_x, 0.0]], inner, [[end_x, 0.0]]])


def _resample_evenly(arc: F64, count: int) -> F64:
    """Sample `count` points at equal arc length, including the first but not the last."""
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(arc, axis=0).T))])
    wanted = length[-1] * np.arange(count) / count
    return np.stack([np.interp(wanted, length, arc[:, axis]) for axis in (0, 1)], axis=1)
