# SPDX-License-Identifier: Apache-2.0
"""Flow that is kept for some images, at a low resolution, and the points that it moves."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64, Flow

FLOW_REDUCTION = 2
"""Flow is kept at this fraction of its resolution: a keypoint moves with its surroundings, and it takes less memory."""


def propagate_points(points: F64, flows: Sequence[Flow], size: tuple[int, int], keep: bool = False) -> F64:
    """Return points (..., 2) px moved along forward flows, one image after the other.

    `flows` are (h, w, 2), displacements as fractions of the image's width and height; `size` is (width, height) of the
    image that the points are in. Where the flow is unknown the point is NaN, or with `keep` stays where it was.
    """
    if not points.size:
        return points
    fractions = (points.reshape(-1, 2) + 0.5) / size
    for flow in flows:
        at = (fractions * (flow.shape[1], flow.shape[0]) - 0.5).astype(np.float32)
        moved = cv2.remap(flow, at[:, None, :], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        step = np.where(np.isfinite(at), moved[:, 0], np.nan)
        fractions = fractions + (np.nan_to_num(step) if keep else step)
    return np.asarray(fractions * size - 0.5).reshape(points.shape)


def reduce_flow(flow: Flow) -> Flow:
    """Return a flow field (h, w, 2) px at a fraction of its resolution, as fractions of its width and height."""
    height, width = flow.shape[:2]
    small = max(1, width // FLOW_REDUCTION), max(1, height // FLOW_REDUCTION)
    fractions = np.array([1 / width, 1 / height], np.float32)
    return np.asarray(cv2.resize(flow, small, interpolation=cv2.INTER_AREA) * fractions, np.float32)
