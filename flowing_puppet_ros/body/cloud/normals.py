# SPDX-License-Identifier: Apache-2.0
"""Downsampling of clouds, and normals for clouds without them."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from flowing_puppet_ros.body.cloud.mesh_geometry import sum_groups
from flowing_puppet_ros.errors import InputError

MIN_NEIGHBOURS, MAX_NEIGHBOURS = 9, 24  # points by which a normal is estimated
POINTS_PER_NEIGHBOUR = 100  # points of a cloud for each of them
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
        cells = np.floor((kept[:, :3] - kept[:, :3].min(axis=0)) / size).astype(np.int64)
        _, group = np.unique(np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1)), return_inverse=True)
        total = np.bincount(group, weight)
        kept, weight = sum_groups(kept * weight[:, None], group) / total[:, None], total
        size *= max(1.05, np.sqrt(len(kept) / max_points))
    if normals is None:
        return kept, None
    length = np.linalg.norm(kept[:, 3:], axis=1, keepdims=True)
    return np.ascontiguousarray(kept[:, :3]), kept[:, 3:] / np.where(length > 1e-9, length, 1)


def estimate_normals(
    points: np.ndarray, viewpoint: np.ndarray | None, surface: tuple[np.ndarray, np.ndarray] | None = None
) -> np.ndarray:
    """Estimate the outward unit normals (N, 3) of a cloud (N, 3) in metres, with Open3D.

    Normals of a single view are oriented towards `viewpoint` (3,). Near a known `surface`, its points (M, 3) and
    outward normals (M, 3), they are oriented as those of its nearest points, in a fraction of the time. Otherwise they
    are made consistent over tangent planes (Hoppe et al. 1992), and all are flipped when most point into the body.

    Raises:
        InputError: when the points lie in a plane or on a line, where no side is outside.
    """
    import open3d as o3d

    # The Delaunay graph behind the consistent orientation loses precision far from the origin.
    center = points.mean(axis=0)
    points = points - center
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    # A neighbourhood must stay smaller than a limb, however few the points are.
    neighbours = int(np.clip(len(points) // POINTS_PER_NEIGHBOUR, MIN_NEIGHBOURS, MAX_NEIGHBOURS))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(neighbours))
    if viewpoint is not None:
        cloud.orient_normals_towards_camera_location(viewpoint - center)
        return np.asarray(cloud.normals).copy()
    if surface is not None:
        surface_points, surface_normals = surface
        normals = np.asarray(cloud.normals).copy()
        cosine = (normals * surface_normals[cKDTree(surface_points - center).query(points)[1]]).sum(axis=1)
        return normals * np.where(cosine < 0, -1.0, 1.0)[:, None]
    try:
        cloud.orient_normals_consistent_tangent_plane(neighbours // 2 + 2)
    except RuntimeError as error:
        raise InputError(
            f"the {len(points)} points of the cloud lie in a plane or on a line, so their normals are unknown;"
            " give the surface of a person"
        ) from error
    normals = np.asarray(cloud.normals).copy()
    # Around a limb the mean of a neighbourhood lies inside it, so that outward normals point away from it.
    near = cKDTree(points).query_ball_point(points[:: max(1, len(points) // 500)], ORIENTATION_RADIUS_M)
    outward = [
        float(normals[index] @ (points[index] - points[rows].mean(axis=0)))
        for index, rows in zip(range(0, len(points), max(1, len(points) // 500)), near, strict=True)
    ]
    return normals if np.sum(outward) >= 0 else -normals
