# SPDX-License-Identifier: Apache-2.0
"""The people in a cloud of a scene: floor and walls removed, the rest cut into clusters, person-like ones kept."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from flowing_puppet_ros.body.segmentation.planes import Plane, PlaneCache, find_floor, find_wall
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.settings import Settings, setting

VOXELS_A_GAP = 2.5
NEAR = 4.0
"""Metres from the sensor up to which `gap` holds; beyond, points lie farther apart in proportion."""
MAX_WALLS = 8
PLANE_POINTS = 8000
# Least and largest of a person's three extents in metres, longest first, and between which they are usual.
EXTENTS = ((0.5, 0.9, 2.0, 2.6), (0.15, 0.3, 1.1, 1.9), (0.02, 0.07, 0.8, 1.3))
FLAT_SHARE = (0.6, 0.8)
"""Shares of places on three planes at right angles: of a person at most the first, of furniture the second and more."""
FLAT_COSINE, SQUARE_COSINE = np.cos(np.radians(20.0)), np.sin(np.radians(20.0))
CLAIM, LEAST_SHARE, MOST_SHARE = 0.25, 0.1, 0.5
"""Metres from a known body within which places may be its own; shares of a cluster from which it claims these places,
and from which all of the cluster."""
LOWEST = (0.5, 1.2)
"""Metres above the floor at which a person's lowest point usually lies, and where it cannot."""


@dataclass(frozen=True)
class SegmentationSettings(Settings):
    """Settings of `extract_people`."""

    max_people: int = setting(8, "most people taken from a cloud, the likeliest first", low=1, high=100)
    reach: float = setting(30.0, "distance from the sensor beyond which points are left out", unit="m",
                           low=0.5, high=1000.0)  # fmt: skip
    clearance: float = setting(0.05, "height above the floor, or distance from a wall, up to which points belong to it",
                               unit="m", low=0.005, high=0.5)  # fmt: skip
    gap: float = setting(0.12, "widest gap in a person's surface up to 4 m from the sensor", unit="m",
                         low=0.02, high=1.0)  # fmt: skip
    least_points: int = setting(60, "points of a person", low=50, high=100000)
    min_score: float = setting(0.5, "least likeness to a person", low=0.0, high=1.0)


@dataclass(frozen=True, slots=True, eq=False)
class PersonCloud:
    """One person's part of a cloud.

    Attributes:
        points: (N, 3) metres.
        normals: (N, 3) or None, as they came.
        rows: (N,) indices into the scene's points, ascending.
        likeness: 0 to 1, how much size, shape and place are a person's.
        owner: index of the known body that stands in these points, None of somebody new.
    """

    points: np.ndarray
    normals: np.ndarray | None
    rows: np.ndarray
    score: float
    owner: int | None = None


def segment_people(
    points: np.ndarray,
    normals: np.ndarray | None,
    settings: SegmentationSettings,
    viewpoint: np.ndarray | None = None,
    known: Sequence[np.ndarray] = (),
    memory: PlaneCache | None = None,
) -> list[PersonCloud]:
    """Find the people in a scene; the same cloud gives the same answer.

    Who is known keeps their points when they touch somebody else or fall into pieces behind something, and is taken
    for a person however little of them is seen.

    Args:
        points: (N, 3) metres, z up; those that are not finite are ignored.
        normals: (N, 3) or None; only passed on.
        settings: limits.
        viewpoint: (3,) where the sensor stood; None when the cloud was joined from several places, so that gaps do
            not grow with the distance.
        known: points (K, 3) in metres on each body that is expected in the cloud, where it should be by now.
        memory: the planes of the clouds before this one, which save looking for floor and walls in every cloud.

    Returns:
        The known people, then the new ones, the likeliest first; empty when there is none.

    Raises:
        InputError: when the arrays have wrong shapes.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or (normals is not None and np.shape(normals) != points.shape):
        raise InputError(f"a scene has points (N, 3) and as many normals or none, not an array of shape {points.shape}")
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    origin = viewpoint if viewpoint is not None else np.median(points[rows], axis=0) if len(rows) else np.zeros(3)
    rows = rows[np.linalg.norm(points[rows] - origin, axis=1) < settings.reach]
    if len(rows) < settings.least_points:
        return []
    # Small numbers keep their digits in what follows, wherever the map's origin is.
    local = points[rows] - origin
    drawn_in = _compensate_range(local) if viewpoint is not None else local
    voxel = _voxels(drawn_in, settings.gap / VOXELS_A_GAP)
    centres = _means(local, voxel)
    free, floor = _without_planes(centres, settings.clearance, origin, memory)
    label = np.full(len(centres), -1)
    label[free] = _clusters(_means(drawn_in, voxel)[free], settings.gap)
    strangers = label.max() + 1
    if known and len(free):
        whole = {
            number for number, group in _groups(label[voxel])
            if person_score(local[group], floor) >= settings.min_score
        }  # fmt: skip
        label[free] = _assign_to_known(centres[free] + origin, label[free], known, whole)
    people = []
    for number, group in _groups(label[voxel]):
        owner = int(number - strangers) if number >= strangers else None
        likeness = person_score(local[group], floor)
        if len(group) >= settings.least_points and (owner is not None or likeness >= settings.min_score):
            chosen = rows[group]
            own_normals = None if normals is None else normals[chosen]
            people.append(PersonCloud(points[chosen], own_normals, chosen, likeness, owner))
    people.sort(key=lambda person: (person.owner is None, -person.score))
    return people[: settings.max_people]


def _assign_to_known(
    centres: np.ndarray, label: np.ndarray, known: Sequence[np.ndarray], whole: Set[int]
) -> np.ndarray:
    """Labels (M,) with the places (M, 3) of the k-th known body's points under the first free label + k.

    A body takes a cluster of which it explains most, and one of those that are a `whole` person even where it lags
    behind. It takes what is near it of a larger one, and clusters that several bodies stand in are divided by the
    nearest body.
    """
    trees = [cKDTree(points) for points in known]
    distance = np.stack([tree.query(centres)[0] for tree in trees])
    nearest, closest = distance.argmin(axis=0), distance.min(axis=0)
    claimed, first = label.copy(), int(label.max()) + 1
    for number, group in _groups(label):
        near = group[closest[group] < CLAIM]
        share = np.bincount(nearest[near], minlength=len(known)) / len(group)
        owners = np.flatnonzero(share > LEAST_SHARE)
        if not len(owners):
            continue
        taken = group if share.sum() > MOST_SHARE or number in whole else near
        claimed[taken] = first + owners[distance[np.ix_(owners, taken)].argmin(axis=0)]
    return claimed


def person_score(points: np.ndarray, floor: Plane | None) -> float:
    """How much (0 to 1) a cluster (N, 3) in metres is like a person: three extents, curvature, height above a floor."""
    if len(points) < 3:
        return 0.0
    middle = points.mean(axis=0)
    axes = np.linalg.svd((points - middle).T @ (points - middle))[0]
    extents = np.ptp(np.percentile((points - middle) @ axes, (2, 98), axis=0), axis=0)
    likeness = 1.0
    for extent, limits in zip(extents, EXTENTS, strict=True):
        likeness *= float(np.interp(extent, limits, (0.0, 1.0, 1.0, 0.0)))
    if likeness > 0:
        likeness *= float(np.interp(_flat_share(points), FLAT_SHARE, (1.0, 0.0)))
    if floor is not None:
        likeness *= float(np.interp(np.percentile(floor.height(points), 2), LOWEST, (1.0, 0.0)))
    return likeness


def _flat_share(points: np.ndarray) -> float:
    """Share of 200 places that lie on three planes at right angles, as those of furniture do (0 to 1)."""
    places = points[np.linspace(0, len(points) - 1, min(200, len(points))).astype(np.int64)]
    spread = points[:: max(1, len(points) // 2000)]
    near = spread[cKDTree(spread).query(places, k=min(12, len(spread)))[1]]
    near = near - near.mean(axis=1, keepdims=True)
    normals = np.linalg.svd(near.transpose(0, 2, 1) @ near)[0][:, :, 2]
    cosine = np.abs(normals @ normals.T)
    first = int((cosine > FLAT_COSINE).sum(axis=0).argmax())
    upright = np.where(cosine[first] < SQUARE_COSINE, (cosine > FLAT_COSINE).sum(axis=0), -1)
    second = int(upright.argmax())
    third = np.abs(normals @ np.cross(normals[first], normals[second]))
    return float(((cosine[first] > FLAT_COSINE) | (cosine[second] > FLAT_COSINE) | (third > FLAT_COSINE)).mean())


def _compensate_range(points: np.ndarray) -> np.ndarray:
    """Points beyond `NEAR` drawn in towards the sensor at 0, so that distances shrink as the sensor's grid widens."""
    distance = np.linalg.norm(points, axis=1, keepdims=True)
    far = np.maximum(distance / NEAR, 1.0)
    return points * (1 + np.log(far)) / far


def _voxels(points: np.ndarray, size: float) -> np.ndarray:
    """Number (N,) of the occupied voxel that each point lies in."""
    cells = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    shape = cells.max(axis=0) + 1
    return np.unique(np.ravel_multi_index(tuple(cells.T), tuple(shape)), return_inverse=True)[1]


def _means(points: np.ndarray, voxel: np.ndarray) -> np.ndarray:
    count = np.bincount(voxel)
    return np.stack([np.bincount(voxel, column) / count for column in points.T], axis=1)


def _without_planes(
    centres: np.ndarray, clearance: float, origin: np.ndarray, memory: PlaneCache | None
) -> tuple[np.ndarray, Plane | None]:
    """Which voxels (M,) belong neither to the floor nor to what is below it nor to walls, and the floor.

    `centres` are relative to `origin`, which may differ from cloud to cloud.
    """
    known = memory.get(centres, clearance, origin) if memory else None
    floor, walls = known or _found_planes(centres, clearance)
    if memory and known is None:
        memory.put(centres, clearance, floor, walls, origin)
    return np.flatnonzero(_above_planes(centres, clearance, floor, walls)), floor


def _above_planes(centres: np.ndarray, clearance: float, floor: Plane | None, walls: Sequence[Plane]) -> np.ndarray:
    off = np.ones(len(centres), dtype=bool) if floor is None else floor.height(centres) > clearance
    for wall in walls:
        off &= np.abs(wall.height(centres)) > clearance
    return off


def _found_planes(centres: np.ndarray, clearance: float) -> tuple[Plane | None, list[Plane]]:
    rng = np.random.default_rng(0)
    floor = find_floor(_some(centres), clearance, rng)
    walls: list[Plane] = []
    while len(walls) < MAX_WALLS:
        free = centres[_above_planes(centres, clearance, floor, walls)]
        wall = find_wall(_some(free), clearance, rng) if len(free) >= 3 else None
        if wall is None:
            break
        walls.append(wall)
    return floor, walls


def _some(points: np.ndarray) -> np.ndarray:
    """Evenly chosen points, as many as are enough to find planes."""
    return np.ascontiguousarray(points[:: 1 + len(points) // PLANE_POINTS])


def _clusters(points: np.ndarray, gap: float) -> np.ndarray:
    """Cluster (M,) of each point: points closer than `gap` belong together (Ester et al. 1996, without noise)."""
    import open3d as o3d

    if not len(points):
        return np.empty(0, dtype=np.int64)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    return np.asarray(cloud.cluster_dbscan(eps=gap, min_points=1)).astype(np.int64)


def _groups(label: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """Indices of the points of each label that is not negative."""
    order = np.argsort(label, kind="stable")
    starts = np.flatnonzero(np.diff(label[order], prepend=-2))
    groups = np.split(order, starts[1:])
    return [(int(label[group[0]]), group) for group in groups if label[group[0]] >= 0]
