# SPDX-License-Identifier: Apache-2.0
"""Distances to masks and outlines that come out the same to the last bit."""

from __future__ import annotations

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64, U8, Array, Bools

MAX_DISTANCE = 512.0  # pixels; larger distances are cut off here


def distance_transform(mask: Bools) -> F64:
    """Distance (h,w) in pixels of every pixel's centre to the nearest one of `mask` (h,w), at most `FARTHEST`.

    OpenCV's exact transform takes square roots whose last bit depends on how its memory is aligned, so two runs differ.
    Squared distances between pixel centres are whole numbers: rounding to them removes the difference.
    """
    empty: Array = np.ascontiguousarray(~mask).astype(np.uint8)
    rough = np.minimum(cv2.distanceTransform(empty, cv2.DIST_L2, cv2.DIST_MASK_PRECISE), MAX_DISTANCE)
    return np.sqrt(np.rint(rough.astype(np.float64) ** 2))


def signed_distance(mask: U8) -> F64:
    """Distance (h,w) in pixels to the outline of `mask` (h,w), positive outside, negative inside.

    The outline runs half a pixel before the centres of the nearest pixels of the other side.
    """
    inside = mask > 0
    return np.where(inside, 0.5 - distance_transform(~inside), distance_transform(inside) - 0.5)
