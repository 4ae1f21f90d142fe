# SPDX-License-Identifier: Apache-2.0
"""Whether a cloud shows one side of a surface only, and from where it was seen; in any frame and unit."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

PROBES, PROBE_NEIGHBOURS = 1000, 5
"""Points at which layers are counted, and neighbours of each, the point itself among them."""
MIN_DENSE_POINTS = 2000  # clouds of fewer points are sparse
MAX_DENSE_LAYER_RATIO, MAX_SPARSE_LAYER_RATIO = 4.0, 2.3
"""Spread of the distance to the sensor among neighbours in direction, over that among neighbours in space, below which
a cloud has one layer, with at least and with fewer than `MIN_DENSE_POINTS` points. In whole bodies it is 2.4 and more
for 500 points and 7 and more for dense clouds, in single views 1.4 to 2.3."""
DIRECTIONS, FAST_POINTS, FAST_PROBES, MEAN_OF = 60, 2500, 400, 5
"""Half of the directions that are tried when the sensor's place is not known, points and probes by which they are
compared, and the best ones whose mean is taken."""
MAX_DENSE_DEPTH_RATIO, MAX_SPARSE_DEPTH_RATIO = 1.3, 0.95
"""The ratio, with neighbours' extents in space instead, below which the best of all directions shows one layer. In
whole bodies it is 1.7 and more (500 points: 1.1), in single views 0.6 to 0.85."""
CURVED_RADIUS, MIN_CURVED_POINTS = 0.07, 8
"""Radius, in longest sides of the cloud, within which the surface's curvature is fitted, and points that it takes."""
MIN_CONVEX_MAJORITY = 0.12
"""By how much the share of convex places differs from a half where front and back can be told apart."""
MIN_THICKNESS = 0.01  # thickness, in longest sides, of a cloud that is not flat
MIN_SAME_COSINE = np.cos(np.radians(40.0))
"""Cosine of the angle between a named place and the estimated one up to which the named one is believed."""
MIN_DISTANCE = 0.05  # of a sensor from the cloud's box, in longest sides of it
VIEW_EXTENTS = 2.5  # longest sides of the cloud at which the sensor is supposed


def is_seen_from(points: np.ndarray, sensor: np.ndarray) -> bool:
    """Return whether a cloud (N, 3) shows only what a sensor at `sensor` (3,), outside of its box, sees.

    Behind the front of a whole body, in the same direction, lies its back; behind what a sensor saw lies nothing.
    """
    if not _is_outside(points, sensor):
        return False
    points = points - sensor
    distance = np.linalg.norm(points, axis=1)
    if not distance.all():
        return False
    probes = np.linspace(0, len(points) - 1, min(PROBES, len(points))).astype(np.int64)
    spread = []
    for places in (points / distance[:, None], points):
        near = cKDTree(places).query(places[probes], k=min(PROBE_NEIGHBOURS, len(points)))[1]
        spread.append(np.median(np.ptp(distance[near], axis=1)))
    limit = MAX_SPARSE_LAYER_RATIO if len(points) < MIN_DENSE_POINTS else MAX_DENSE_LAYER_RATIO
    return bool(spread[0] < limit * spread[1])


def estimate_viewpoint(points: np.ndarray) -> np.ndarray | None:
    """Estimate from the surface alone where the sensor (3,) of a cloud (N, 3) stood; None when it shows all sides.

    Some direction sees a one-sided cloud in one layer. The sensor is at that end of it towards which the surface
    bulges. The error is about 10 degrees; the distance is a guess of 2.5 longest sides.
    """
    middle = points.mean(axis=0)
    spread = np.random.default_rng(0).permutation(len(points))[:FAST_POINTS]
    chosen = points[spread] - middle
    longest = float(np.ptp(chosen, axis=0).max())
    if not longest or np.linalg.svd(chosen, compute_uv=False)[2] < MIN_THICKNESS * longest * np.sqrt(len(chosen)):
        return None
    directions = _spread_half_sphere(DIRECTIONS)
    ratio = _depth_ratios(chosen, directions)
    dense = len(points) >= MIN_DENSE_POINTS
    best = np.argsort(ratio, kind="stable")[:MEAN_OF]
    if ratio[best[0]] >= (MAX_DENSE_DEPTH_RATIO if dense else MAX_SPARSE_DEPTH_RATIO):
        return None
    signs = np.where(directions[best] @ directions[best[0]] < 0, -1.0, 1.0)
    direction = (signs[:, None] * directions[best]).sum(axis=0)
    direction /= np.linalg.norm(direction)
    convex = _share_convex(chosen, direction, CURVED_RADIUS * longest) - 0.5
    if abs(convex) < MIN_CONVEX_MAJORITY:
        return None
    return np.asarray(middle + np.sign(convex) * VIEW_EXTENTS * longest * direction)


def find_viewpoint(points: np.ndarray, named: np.ndarray | None) -> np.ndarray | None:
    """Return the position (3,) of the sensor of a one-sided cloud (N, 3), None for a cloud that shows all sides.

    The place `named` (3,) by the file and the origin come first, unless the surface bulges elsewhere.
    """
    estimated = estimate_viewpoint(points)
    middle = points.mean(axis=0)
    for sensor in (place for place in (named, np.zeros(3)) if place is not None):
        believed = estimated is None or _cosine(middle, sensor, estimated) > MIN_SAME_COSINE
        if believed and is_seen_from(points, sensor):
            return sensor
    return estimated


def choose_viewpoint(points: np.ndarray, normals: np.ndarray | None, named: np.ndarray | None) -> np.ndarray | None:
    """Return the likeliest position (3,) of the sensor of a cloud (N, 3) known to be one-sided; None if nothing tells.

    It is where the surface says, else the place `named` (3,) by the file or the origin outside of the cloud, else in
    the mean direction of the normals (N, 3).
    """
    found = find_viewpoint(points, named)
    if found is not None:
        return found
    for sensor in (named, np.zeros(3)):
        if sensor is not None and _is_outside(points, sensor):
            return sensor
    if normals is None:
        return None
    mean = normals.mean(axis=0) / max(float(np.linalg.norm(normals.mean(axis=0))), 1e-9)
    return np.asarray(points.mean(axis=0) + VIEW_EXTENTS * float(np.ptp(points, axis=0).max()) * mean)


def _cosine(middle: np.ndarray, first: np.ndarray, second: np.ndarray) -> float:
    """Return the cosine of the angle between two places (3,) as seen from a third."""
    a, b = first - middle, second - middle
    return float(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)))


def _is_outside(points: np.ndarray, place: np.ndarray) -> bool:
    """Return whether a sensor can stand at a place: outside of the cloud's box, and not on its border."""
    low, high = points.min(axis=0), points.max(axis=0)
    return bool(np.max([low - place, place - high]) > MIN_DISTANCE * np.max(high - low))


def _depth_ratios(points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return per direction (D,) the depth among neighbours at a right angle to it, over their extent in space."""
    probes = np.linspace(0, len(points) - 1, min(FAST_PROBES, len(points))).astype(np.int64)
    count = min(PROBE_NEIGHBOURS, len(points))
    near = cKDTree(points).query(points[probes], k=count)[1]
    extent = np.median(np.linalg.norm(np.ptp(points[near], axis=1), axis=1))
    ratio = np.empty(len(directions))
    for k, direction in enumerate(directions):
        across, depth = points @ _make_plane(direction).T, points @ direction
        ratio[k] = np.median(np.ptp(depth[cKDTree(across).query(across[probes], k=count)[1]], axis=1))
    return ratio / max(float(extent), 1e-12)


def _share_convex(points: np.ndarray, direction: np.ndarray, radius: float) -> float:
    """Return the share of places whose surface bulges towards `direction` (3,), by the Laplacian of the depth there."""
    across, depth = points @ _make_plane(direction).T, points @ direction
    probes = np.linspace(0, len(points) - 1, min(FAST_PROBES, len(points))).astype(np.int64)
    convex = []
    for probe, near in zip(probes, cKDTree(points).query_ball_point(points[probes], radius), strict=True):
        if len(near) >= MIN_CURVED_POINTS:
            u, v = (across[near] - across[probe]).T / radius
            terms = np.column_stack([np.ones_like(u), u, v, u * u, u * v, v * v])
            fitted = np.linalg.lstsq(terms, depth[near] - depth[probe], rcond=None)[0]
            convex.append(fitted[3] + fitted[5] < 0)
    return float(np.mean(convex)) if convex else 0.5


def _make_plane(direction: np.ndarray) -> np.ndarray:
    """Return two axes (2, 3) at right angles to a unit vector (3,)."""
    first = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)])


def _spread_half_sphere(count: int) -> np.ndarray:
    """Return directions (count, 3) spread over half of the sphere on a Fibonacci spiral."""
    index = np.arange(count) + 0.5
    polar, around = np.arccos(1 - index / count), np.pi * (1 + 5**0.5) * index
    return np.stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)], axis=1)
