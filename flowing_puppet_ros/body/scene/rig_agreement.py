# SPDX-License-Identifier: Apache-2.0
"""What one sensor saw where another saw through: flying pixels, or sensors that are not where they are said to be."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import minimum_filter

from flowing_puppet_ros.arrays import F64, Bools
from flowing_puppet_ros.body.cloud.normals import downsample
from flowing_puppet_ros.body.scene.scene_cloud import SceneCloud
from flowing_puppet_ros.body.segmentation.planes import find_planes, is_clear_of_planes
from flowing_puppet_ros.evidence.cloud.range_image import RangeImage

FREE_DEPTH_M = 0.1
"""Depth before what a sensor saw from which on a place is free: less may be noise, or a cloud of another time."""
BESIDE_M, BESIDE_AT_M = 0.03, 2.5
"""Distance to the side, at this distance from the sensor, within which something hides a place for it all the same."""
PLANE_CLEARANCE_M, MAX_PLANE_POINTS = 0.08, 8000
"""Distance from floor and walls within which points say nothing about the sensors, and points by which those are found:
walls are the most of what is seen, and a shift along them shows nowhere."""
MIN_COMPARED_POINTS = 200


def find_seen_through(parts: Sequence[SceneCloud]) -> list[Bools]:
    """Return for each sensor which of its points (N,) another one saw through; the clouds are in one frame."""
    return [np.any([through for _, through in row], axis=0) for row in _compare(parts)]


def measure_disagreement(parts: Sequence[SceneCloud]) -> F64:
    """Return (S, S) the share of the points of the first sensor, in sight of the second, that the second saw through.

    Floor and walls do not count; NaN where too few points are left.
    """
    every = np.concatenate([part.points for part in parts])
    floor, walls = find_planes(downsample(every, None, MAX_PLANE_POINTS)[0], PLANE_CLEARANCE_M)
    share = np.full((len(parts), len(parts)), np.nan)
    for first, row in enumerate(_compare(parts)):
        clear = is_clear_of_planes(parts[first].points, PLANE_CLEARANCE_M, floor, walls)
        for second, (seen, through) in enumerate(row):
            if np.count_nonzero(seen & clear) >= MIN_COMPARED_POINTS:
                share[first, second] = through[seen & clear].mean()
    return share


def _compare(parts: Sequence[SceneCloud]) -> list[list[tuple[Bools, Bools]]]:
    """Return, by sensor and other sensor, which points (N,) the other looked at unhidden, and which it saw through."""
    images = [part.draw_image() if len(part.points) else None for part in parts]
    near = [None if image is None else _find_nearest(image) for image in images]
    found = []
    for first, part in enumerate(parts):
        nothing = np.zeros(len(part.points), dtype=bool)
        row = []
        for second, (image, nearest) in enumerate(zip(images, near, strict=True)):
            is_other = second != first and image is not None and nearest is not None and len(part.points)
            row.append(_look_through(image, nearest, part.points) if is_other else (nothing, nothing))  # type: ignore[arg-type]
        found.append(row)
    return found


def _find_nearest(image: RangeImage) -> F64:
    """Return the least depth (H, W) m about each pixel, infinite where the pixel itself has none."""
    reach = int(np.ceil(BESIDE_M / BESIDE_AT_M * float(np.abs(image.projection.scale).max())))
    return np.where(np.isfinite(image.depth), minimum_filter(image.depth, 2 * reach + 1), np.inf)


def _look_through(image: RangeImage, nearest: F64, points: F64) -> tuple[Bools, Bools]:
    """Return which places (N, 3) m a sensor looked at and did not find hidden, and which it saw through, (N,) each."""
    pixels, depth = image.projection.project(points)
    columns, rows = np.floor(pixels + 0.5).astype(np.int64).T
    height, width = nearest.shape
    inside = (depth > 0) & (columns >= 0) & (rows >= 0) & (columns < width) & (rows < height)
    there = nearest[np.where(inside, rows, 0), np.where(inside, columns, 0)]
    seen = inside & np.isfinite(there) & (there > depth - FREE_DEPTH_M)
    return seen, seen & (there > depth + FREE_DEPTH_M)
