# SPDX-License-Identifier: Apache-2.0
"""Whether a cloud shows people from one side, as a sensor at the origin of its frame sees them, or from all sides."""

from __future__ import annotations

import numpy as np

BIN, SPARSE_BIN, SPARSE = 0.06, 0.1, 1500  # metres across one bundle of rays, wider in clouds of fewer points
THICK = 0.12  # metres behind the nearest point of a bundle at which no front side can be
HIDDEN_SHARE = 0.21  # of the points of a whole body at least this share lies behind others
INSIDE = 0.5  # length of the mean direction to the points; shorter when they lie around the origin


def is_single_view(points: np.ndarray) -> bool:
    """Whether a person's points (N, 3) in metres are what a sensor at the origin sees of them.

    From there every bundle of rays ends on one surface; of a whole body it ends on the front and on the back.
    """
    distance = np.linalg.norm(points, axis=1)
    points, distance = points[distance > 0], distance[distance > 0]
    if not len(points):
        return False
    directions = points / distance[:, None]
    if np.linalg.norm(directions.mean(axis=0)) < INSIDE:
        return False
    ahead = directions.mean(axis=0)
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, np.eye(3)[np.abs(ahead).argmin()])
    right /= np.linalg.norm(right)
    plane = np.stack([directions @ right, directions @ np.cross(ahead, right)], axis=1)
    width = BIN if len(points) > SPARSE else SPARSE_BIN
    cells = np.floor(plane * np.median(distance) / width).astype(np.int64)
    bundle = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    nearest = np.full(bundle.max() + 1, np.inf)
    np.minimum.at(nearest, bundle, distance)
    return float((distance > nearest[bundle] + THICK).mean()) < HIDDEN_SHARE
