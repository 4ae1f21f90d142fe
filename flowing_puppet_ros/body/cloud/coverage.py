# SPDX-License-Identifier: Apache-2.0
"""Tells clouds of people seen from one side, by a sensor at the origin of their frame, from clouds of all sides."""

from __future__ import annotations

import numpy as np

BUNDLE_WIDTH_M, SPARSE_BUNDLE_WIDTH_M = 0.06, 0.1  # across one bundle of rays, wider in sparse clouds
MAX_SPARSE_POINTS = 1500  # of a sparse cloud
MAX_FRONT_DEPTH_M = 0.12  # behind the nearest point of a bundle; deeper points lie on the back
MAX_HIDDEN_SHARE = 0.21  # of the points of a single view; in clouds of whole bodies more lie behind others
MIN_MEAN_DIRECTION = 0.5  # length of the mean unit vector to the points; shorter when they surround the origin


def is_single_view(points: np.ndarray) -> bool:
    """Return whether a person's points (N, 3) in metres are what a sensor at the origin sees.

    In a single view every bundle of rays ends on one surface; in a whole body on the front and on the back.
    """
    distance = np.linalg.norm(points, axis=1)
    points, distance = points[distance > 0], distance[distance > 0]
    if not len(points):
        return False
    directions = points / distance[:, None]
    if np.linalg.norm(directions.mean(axis=0)) < MIN_MEAN_DIRECTION:
        return False
    ahead = directions.mean(axis=0)
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, np.eye(3)[np.abs(ahead).argmin()])
    right /= np.linalg.norm(right)
    plane = np.stack([directions @ right, directions @ np.cross(ahead, right)], axis=1)
    width = BUNDLE_WIDTH_M if len(points) > MAX_SPARSE_POINTS else SPARSE_BUNDLE_WIDTH_M
    cells = np.floor(plane * np.median(distance) / width).astype(np.int64)
    bundle = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    nearest = np.full(bundle.max() + 1, np.inf)
    np.minimum.at(nearest, bundle, distance)
    return float((distance > nearest[bundle] + MAX_FRONT_DEPTH_M).mean()) < MAX_HIDDEN_SHARE
