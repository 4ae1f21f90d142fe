# SPDX-License-Identifier: Apache-2.0
"""Distances to masks and their outlines, reproducible to the last bit."""

from __future__ import annotations

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64, U8, Array, Bools

MAX_DISTANCE_PX = 512.0  # larger distances are clipped


def distance_transform(mask: Bools) -> F64:
    """Return the distance (h, w) in pixels of every pixel to the nearest one of `mask` (h, w), up to `MAX_DISTANCE_PX`.

    The last bit of the square roots in OpenCV's exact transform depends on the alignment of memory, so two runs differ.
    Squared distances between pixel centres are integers: rounding to them removes the difference.
    """
    empty: Array = np.ascontiguousarray(~mask).astype(np.uint8)
    rough = np.minimum(cv2.distanceTransform(empty, cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float32(MAX_DISTANCE_PX))
    rough *= rough  # up to 2**18, of which 32 bits hold a 64th
    return np.sqrt(np.rint(rough, out=rough), dtype=np.float64)


def signed_distance(mask: U8) -> F64:
    """Return the distance (h, w) in pixels to the outline of `mask` (h, w), positive outside, negative inside.

    The outline runs half a pixel in front of the nearest pixel centres on the other side.
    """
    inside = mask > 0
    return np.where(inside, 0.5 - distance_transform(~inside), distance_transform(inside) - 0.5)
