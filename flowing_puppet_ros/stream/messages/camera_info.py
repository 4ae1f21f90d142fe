# SPDX-License-Identifier: Apache-2.0
"""The CameraInfo of the images that a driver sends: those of a part of the sensor (`roi`), or binned.

By definition of the message `width`, `height`, `k` and `p` are of the full resolution, and the images are smaller.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import F64


def describe_images(info: Any, size: tuple[int, int] | None = None) -> Any:
    """Return a CameraInfo whose size and matrices are those of the images, `info` itself if it is that already.

    It is for images of `size` (width, height) where that is known: some drivers name binning and write what is binned.
    A size of 0 in `info` is unknown, and that of the images is taken.
    """
    bins = max(1, int(info.binning_x)), max(1, int(info.binning_y))
    window = info.roi
    full = int(info.width), int(info.height)
    cut = int(window.width) or full[0], int(window.height) or full[1]
    if size is not None and full == (0, 0):
        found = copy.copy(info)
        found.width, found.height = size
        return found
    if (bins == (1, 1) and cut == full) or full == size:
        return info
    found = copy.copy(info)
    found.width, found.height = cut[0] // bins[0], cut[1] // bins[1]
    offset = int(window.x_offset), int(window.y_offset)
    found.k, found.p = _reduce(info.k, 3, offset, bins), _reduce(info.p, 4, offset, bins)
    found.binning_x = found.binning_y = 0
    found.roi = copy.copy(window)
    found.roi.x_offset = found.roi.y_offset = found.roi.width = found.roi.height = 0
    return found


def _reduce(matrix: Any, columns: int, offset: tuple[int, int], bins: tuple[int, int]) -> F64:
    """Return the elements of a matrix (3, `columns`) for a window of the image that begins at `offset`, and binned."""
    reduced = np.array(matrix, dtype=np.float64).reshape(3, columns)
    reduced[:2] -= np.array(offset, dtype=np.float64)[:, None] * reduced[2]
    reduced[:2] /= np.array(bins, dtype=np.float64)[:, None]
    return np.asarray(reduced.ravel())
