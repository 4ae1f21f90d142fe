# SPDX-License-Identifier: Apache-2.0
"""Downsampling of clouds, and normals for clouds without them."""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.cloud.nearest import NearestPoints
from flowing_puppet_ros.evidence.cloud.neighbours import find_neighbours, fit_normals

MIN_NEIGHBOURS, MAX_NEIGHBOURS = 9, 24  # points by which a normal is estimated
POINTS_PER_NEIGHBOUR = 100  # points of a cloud for each of them
NEIGHBOURS_PER_STRETCH = 3  # for the rings of a LiDAR: those of one ring lie on a line and say nothing about a plane
MAX_RING_NEIGHBOURS = 40
MIN_SPREAD = 1e-6  # of points across their widest plane, for one along it; they lie in that plane below it
ORIENTATION_RADIUS_M = 0.12  # neighbourhood whose mean lies inside a limb


def downsample(points: np.ndarray, normals: np.ndarray | None, max_points: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Replace the points of each voxel by their mean, in growing voxels, until at most `max_points` are left.

    Args:
        points: (N, 3) in any unit.
        normals: (N, 3) unit normals or None.
        max_points: maximum number of points.

    Returns:
        Points and normals; unchanged when they are few enough.
    """
    if len(points) <= max_points:
        return points, normals
    kept = points if normals is None else np.concatenate([points, normals], axis=1)
    size, weight = float(np.ptp(points, axis=0).max()) / 400, np.ones(len(points))
    while len(kept) > max_points:
        kept, weight = _merge_cells(np.ascontiguousarray(kept), weight, size)
        size *= max(1.05, np.sqrt(len(kept) / max_points))
    if normals is None:
        return kept, None
    length = np.linalg.norm(kept[:, 3:], axis=1, keepdims=True)
    return np.ascontiguousarray(kept[:, :3]), kept[:, 3:] / np.where(length > 1e-9, length, 1)


@njit(cache=True, nogil=True)
def _merge_cells(values: np.ndarray, weight: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted means (M, K) of the rows (N, K) in each voxel, in the order of the voxels, and their weights.

    The first three columns are the places, and `size` is the voxels' edge in their unit.
    """
    low, cells = values[0, :3].copy(), np.empty((len(values), 3), np.int64)
    for row in range(1, len(values)):
        for axis in range(3):
            low[axis] = min(low[axis], values[row, axis])
    top = np.zeros(3, np.int64)
    for row in range(len(values)):
        for axis in range(3):
            cells[row, axis] = int(np.floor((values[row, axis] - low[axis]) / size))
            top[axis] = max(top[axis], cells[row, axis])
    flat = (cells[:, 0] * (top[1] + 1) + cells[:, 1]) * (top[2] + 1) + cells[:, 2]
    order = np.argsort(flat, kind="mergesort")
    means, total, last = np.zeros_like(values), np.zeros(len(values)), -1
    for place in range(len(order)):
        row = order[place]
        if place == 0 or flat[row] != flat[order[place - 1]]:
            last += 1
        total[last] += weight[row]
        for column in range(values.shape[1]):
            means[last, column] += values[row, column] * weight[row]
    for row in range(last + 1):
        for column in range(values.shape[1]):
            means[row, column] /= total[row]
    return means[: last + 1], total[: last + 1]


def estimate_view_normals(points: np.ndarray, viewpoint: np.ndarray, stretch: float) -> np.ndarray:
    """Estimate the unit normals (N, 3), towards `viewpoint` (3,), of a cloud (N, 3) in metres that was seen from there.

    `stretch` is that of `OneSidedView`.
    """
    center = points.mean(axis=0)
    points, count = points - center, _count_neighbours(points)  # covariances lose precision far from the origin
    if stretch > 1:
        count = max(count, min(round(NEIGHBOURS_PER_STRETCH * stretch), MAX_RING_NEIGHBOURS))
    return _turn_along(fit_normals(points, find_neighbours(points, count)), viewpoint - center - points)


def estimate_normals(points: np.ndarray, surface: tuple[np.ndarray, np.ndarray] | None = None) -> np.ndarray:
    """Estimate the outward unit normals (N, 3) of a cloud (N, 3) in metres, by the planes through the nearest points.

    Near a known `surface`, its points (M, 3) and outward normals (M, 3), they are oriented as those of its nearest
    points, in a fraction of the time. Otherwise they are made consistent over tangent planes (Hoppe et al. 1992), and
    all are flipped when most point into the body.

    Raises:
        InputError: when the points lie in a plane or on a line, where no side is outside.
    """
    center = points.mean(axis=0)
    points, count = points - center, _count_neighbours(points)  # covariances lose precision far from the origin
    normals = fit_normals(points, find_neighbours(points, count))
    if surface is not None:
        surface_points, surface_normals = surface
        return _turn_along(normals, surface_normals[NearestPoints(surface_points - center).query(points)[1]])
    normals = _orient_consistently(points, normals, find_neighbours(points, count // 2 + 2))
    # Around a limb the mean of a neighbourhood lies inside it, so that outward normals point away from it.
    near = cKDTree(points).query_ball_point(points[:: max(1, len(points) // 500)], ORIENTATION_RADIUS_M)
    outward = [
        float(normals[index] @ (points[index] - points[rows].mean(axis=0)))
        for index, rows in zip(range(0, len(points), max(1, len(points) // 500)), near, strict=True)
    ]
    return normals if np.sum(outward) >= 0 else -normals


def _count_neighbours(points: np.ndarray) -> int:
    """Return by how many points a normal is estimated: a neighbourhood must stay smaller than a limb."""
    return int(np.clip(len(points) // POINTS_PER_NEIGHBOUR, MIN_NEIGHBOURS, MAX_NEIGHBOURS))


def _turn_along(normals: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the normals (N, 3), with those flipped that point against their direction (N, 3)."""
    return np.asarray(normals * np.where((normals * directions).sum(axis=1) < 0, -1.0, 1.0)[:, None])


def _orient_consistently(points: np.ndarray, normals: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Return the normals (N, 3), flipped where that makes them agree along a tree of the most parallel `neighbours`.

    The tree starts at the topmost point, whose normal points up.
    """
    spread = np.linalg.svd(points.T @ points, compute_uv=False)
    if spread[2] <= MIN_SPREAD**2 * spread[0]:
        raise InputError(
            f"the {len(points)} points of the cloud lie in a plane or on a line, so their normals are unknown;"
            " give the surface of a person"
        )
    count = len(points)
    pairs = np.stack([np.repeat(np.arange(count), neighbours.shape[1]), neighbours.ravel()], axis=1)
    pairs = np.concatenate([pairs, _bridge_gaps(points, pairs)])
    pairs = np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1)
    first, second = np.divmod(np.unique(pairs[:, 0] * count + pairs[:, 1]), count)
    # From 1, because an edge without weight would be none; that changes no tree.
    weight = 2.0 - np.abs((normals[first] * normals[second]).sum(axis=1))
    tree = minimum_spanning_tree(csr_matrix((weight, (first, second)), shape=(count, count)))
    top = int(points[:, 2].argmax())
    order, parents = breadth_first_order(tree, top, directed=False)
    agree = np.where((normals[order[1:]] * normals[parents[order[1:]]]).sum(axis=1) < 0, -1.0, 1.0)
    sign = np.ones(count)
    sign[top] = -1.0 if normals[top, 2] < 0 else 1.0
    for point, same in zip(order[1:].tolist(), agree.tolist(), strict=True):
        sign[point] = same * sign[parents[point]]
    return normals * sign[:, None]


def _bridge_gaps(points: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return the shortest pairs (K, 2) between the largest group of points that `pairs` connect and each other one."""
    graph = coo_matrix((np.ones(len(pairs), dtype=np.int8), pairs.T), shape=(len(points), len(points)))
    label = connected_components(graph, directed=False)[1]
    largest = np.bincount(label).argmax()
    main, others = np.flatnonzero(label == largest), np.flatnonzero(label != largest)
    distance, nearest = cKDTree(points[main]).query(points[others])
    closest = others[np.lexsort((distance, label[others]))]
    chosen = np.flatnonzero(np.diff(label[closest], prepend=-1))
    bridge = closest[chosen]
    return np.stack([bridge, main[nearest[np.searchsorted(others, bridge)]]], axis=1)
