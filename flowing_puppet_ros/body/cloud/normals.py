# SPDX-License-Identifier: Apache-2.0
"""Thinning of clouds and normals for clouds that come without."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from flowing_puppet_ros.errors import InputError

NEIGHBOURS = (9, 24)
POINTS_A_NEIGHBOUR = 100


def downsample(points: np.ndarray, normals: np.ndarray | None, limit: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Replace the points of each voxel by their mean until at most `limit` are left.

    Args:
        points: (N, 3).
        normals: (N, 3) unit or None.
        limit: wanted number of points.

    Returns:
        Points and normals; untouched when they are few enough.
    """
    if len(points) <= limit:
        return points, normals
    kept = points if normals is None else np.concatenate([points, normals], axis=1)
    size, weight = float(np.ptp(points, axis=0).max()) / 400, np.ones(len(points))
    while len(kept) > limit:
        cells = np.floor((kept[:, :3] - kept[:, :3].min(axis=0)) / size).astype(np.int64)
        _, group = np.unique(np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1)), return_inverse=True)
        total = np.bincount(group, weight)
        kept, weight = _sums(kept * weight[:, None], group) / total[:, None], total
        size *= max(1.05, np.sqrt(len(kept) / limit))
    if normals is None:
        return kept, None
    length = np.linalg.norm(kept[:, 3:], axis=1, keepdims=True)
    return np.ascontiguousarray(kept[:, :3]), kept[:, 3:] / np.where(length > 1e-9, length, 1)


def _sums(values: np.ndarray, group: np.ndarray) -> np.ndarray:
    return np.stack([np.bincount(group, column) for column in values.T], axis=1)


def estimate_normals(
    points: np.ndarray, viewpoint: np.ndarray | None, surface: tuple[np.ndarray, np.ndarray] | None = None
) -> np.ndarray:
    """Outward unit normals (N, 3) of a cloud (N, 3) in metres, by Open3D.

    Seen from one place they turn towards it. Beside a known `surface`, its points (M, 3) and outward normals (M, 3),
    they turn as those of the nearest of its points, which takes a fraction of the time. Otherwise they are made
    consistent over tangent planes (Hoppe et al. 1992), and all are turned over when most point towards the body's
    inside.

    Raises:
        InputError: when the points lie in a plane or on a line, where no side is outside.
    """
    import open3d as o3d

    # The Delaunay graph behind the consistent orientation loses its digits far from the origin.
    center = points.mean(axis=0)
    points = points - center
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    # A neighbourhood must stay smaller than a limb, however few the points are.
    neighbours = int(np.clip(len(points) // POINTS_A_NEIGHBOUR, *NEIGHBOURS))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(neighbours))
    if viewpoint is not None:
        cloud.orient_normals_towards_camera_location(viewpoint - center)
        return np.asarray(cloud.normals).copy()
    if surface is not None:
        places, outward_there = surface
        normals = np.asarray(cloud.normals).copy()
        likeness = (normals * outward_there[cKDTree(places - center).query(points)[1]]).sum(axis=1)
        return normals * np.where(likeness < 0, -1.0, 1.0)[:, None]
    try:
        cloud.orient_normals_consistent_tangent_plane(neighbours // 2 + 2)
    except RuntimeError as error:
        raise InputError(
            f"the {len(points)} points of the cloud lie in a plane or on a line, so their normals are unknown;"
            " give the surface of a person"
        ) from error
    normals = np.asarray(cloud.normals).copy()
    # Around a limb the mean of a neighbourhood lies inside it, so that outward normals point away from it.
    near = cKDTree(points).query_ball_point(points[:: max(1, len(points) // 500)], 0.12)
    outward = [
        float(normals[index] @ (points[index] - points[rows].mean(axis=0)))
        for index, rows in zip(range(0, len(points), max(1, len(points) // 500)), near, strict=True)
    ]
    return normals if np.sum(outward) >= 0 else -normals
