# SPDX-License-Identifier: Apache-2.0
"""HOG descriptors along a contour, on it, inside and outside, steered to its local direction (thesis, Figs. 2, 3, 5).

The frame of a descriptor is the outward normal and the direction in which the contour's points run: a contour rotated
or mirrored together with the image keeps its descriptors.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F32, Array, Bools
from flowing_puppet_ros.evidence.image.features import CHANNELS, ORDERS, OrientationMap
from flowing_puppet_ros.evidence.image.outline import clip_coordinates, direction, winding

SIDES = 3
"""Descriptors per contour point: inside the contour, on it, outside."""


def descriptors(level: OrientationMap, contours: Array, places: Array, offset: Array) -> tuple[F32, Bools]:
    """Return steered descriptors (P, n, SIDES, CHANNELS) of `contours` (P, K, 2) px at the point indices `places` (n,).

    `offset` (P,) px is how far inside and outside. The second array (P, n, SIDES) tells which lie in the image; the
    others' descriptors are 0, and so are those of contours that are not finite.
    """
    found = np.zeros((len(contours), len(places), SIDES, CHANNELS), np.float32)
    visible = np.zeros(found.shape[:3], np.bool_)
    places, offset = np.ascontiguousarray(places, np.int64), np.ascontiguousarray(offset, np.float64)
    _descriptors(level.values, *level.scale, clip_coordinates(contours), places, offset, found, visible)
    return found, visible


@njit(cache=True, nogil=True)
def _read(values: Array, x: float, y: float, steer: tuple[float, float, float], out: Array) -> None:
    """Interpolate at level pixel (x, y) and rotate: angles count from the normal; `steer` is cos 2a, sin 2a, hand."""
    height, width = values.shape[0], values.shape[1]
    x, y = min(max(x, 0.0), width - 1.0), min(max(y, 0.0), height - 1.0)
    left, top = int(x), int(y)
    right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
    fx, fy = np.float32(x - left), np.float32(y - top)
    one = np.float32(1.0)
    a, b, c, d = (one - fx) * (one - fy), fx * (one - fy), (one - fx) * fy, fx * fy
    for m in range(out.shape[0]):
        out[m] = a * values[top, left, m] + b * values[top, right, m]
        out[m] += c * values[bottom, left, m] + d * values[bottom, right, m]
    cosine, sine, hand = np.float32(steer[0]), np.float32(steer[1]), np.float32(steer[2])
    turn_re, turn_im = cosine, -sine
    for k in range(ORDERS):
        re, im = out[2 * k + 1], out[2 * k + 2]
        out[2 * k + 1] = re * turn_re - im * turn_im
        out[2 * k + 2] = hand * (re * turn_im + im * turn_re)
        turn_re, turn_im = turn_re * cosine + turn_im * sine, turn_im * cosine - turn_re * sine


@njit(cache=True, nogil=True)
def _descriptors(
    values: Array,
    to_x: float,
    to_y: float,
    contours: Array,
    places: Array,
    offset: Array,
    found: Array,
    visible: Array,
) -> None:
    height, width = values.shape[0], values.shape[1]
    for p in range(contours.shape[0]):
        hand = winding(contours[p])
        if np.isnan(hand):
            continue
        for i in range(places.shape[0]):
            tx, ty = direction(contours[p], places[i])
            steer = (ty * ty - tx * tx, -2.0 * tx * ty, hand)
            for side in range(SIDES):
                out = (side - 1) * offset[p] * hand
                x = (contours[p, places[i], 0] - out * ty + 0.5) * to_x - 0.5
                y = (contours[p, places[i], 1] + out * tx + 0.5) * to_y - 0.5
                if -0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5:
                    visible[p, i, side] = True
                    _read(values, x, y, steer, found[p, i, side])
