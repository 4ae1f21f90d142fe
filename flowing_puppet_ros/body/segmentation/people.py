# SPDX-License-Identifier: Apache-2.0
"""Segments the people in a cloud of a scene: removes floor and walls, clusters the rest, keeps person-like clusters."""

from __future__ import annotations

from collections.abc import Sequence, Set

import numpy as np
from scipy.spatial import cKDTree

from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.segmentation.linkage import link_within
from flowing_puppet_ros.body.segmentation.planes import Plane, PlaneCache, find_planes, is_clear_of_planes
from flowing_puppet_ros.body.settings import SegmentationSettings
from flowing_puppet_ros.errors import InputError

VOXELS_PER_GAP = 2.5  # voxel edges in `max_gap`
MAX_GAP_RANGE_M = 4.0
"""Distance from the sensor up to which `max_gap` holds; beyond, points lie farther apart in proportion."""
EXTENT_LIMITS_M = ((0.5, 0.9, 2.0, 2.6), (0.15, 0.3, 1.1, 1.9), (0.02, 0.07, 0.8, 1.3))
"""A person's three extents, longest first: minimum, the range that scores 1, maximum."""
FLAT_SHARE_LIMITS = (0.6, 0.8)
"""Share of points on three planes at right angles up to which a cluster scores 1, and from which it is furniture."""
MIN_PARALLEL_COSINE, MAX_SQUARE_COSINE = np.cos(np.radians(20.0)), np.sin(np.radians(20.0))
"""Cosine between the normals of parallel planes, and of planes at right angles."""
MAX_OWN_DISTANCE_M, MIN_CLAIM_SHARE, MIN_WHOLE_SHARE = 0.25, 0.1, 0.5
"""Distance to a known body within which points may be its own; shares of a cluster from which on the body takes these
points, and from which on the whole cluster."""
FLOOR_GAP_LIMITS_M = (0.5, 1.2)
"""Height of the lowest point above the floor up to which a cluster scores 1, and from which on it is not a person."""


def segment_people(
    points: np.ndarray,
    normals: np.ndarray | None,
    settings: SegmentationSettings,
    viewpoint: np.ndarray | None = None,
    known: Sequence[np.ndarray] = (),
    plane_cache: PlaneCache | None = None,
) -> list[PersonCloud]:
    """Segment the people in a scene; the same cloud gives the same answer.

    Known people keep their points when they touch another person or are split by something in front of them, and count
    as people however little of them is seen.

    Args:
        points: (N, 3) metres, z up; those that are not finite are ignored.
        normals: (N, 3) or None; only passed on.
        settings: limits.
        viewpoint: (3,) position of the sensor in metres; None when the cloud was merged from several sensors, so that
            gaps do not grow with the distance.
        known: points (K, 3) in metres on each body that is expected in the cloud, at its predicted position.
        plane_cache: planes of earlier clouds, so that not every cloud is searched for floor and walls.

    Returns:
        The known people, then the new ones, each by falling score; empty when there is nobody.

    Raises:
        InputError: when the arrays have wrong shapes.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or (normals is not None and np.shape(normals) != points.shape):
        raise InputError(f"a scene has points (N, 3) and as many normals or none, not an array of shape {points.shape}")
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    origin = viewpoint if viewpoint is not None else np.median(points[rows], axis=0) if len(rows) else np.zeros(3)
    rows = rows[np.linalg.norm(points[rows] - origin, axis=1) < settings.max_range]
    if len(rows) < settings.min_points:
        return []
    # Coordinates near the origin keep their precision, wherever the map's origin is.
    local = points[rows] - origin
    compensated = _compensate_range(local) if viewpoint is not None else local
    voxel = _find_voxels(compensated, settings.max_gap / VOXELS_PER_GAP)
    centres = _average_voxels(local, voxel)
    free, floor = _remove_planes(centres, settings.plane_clearance, origin, plane_cache)
    label = np.full(len(centres), -1)
    label[free] = link_within(_average_voxels(compensated, voxel)[free], settings.max_gap)
    new_clusters = label.max() + 1
    # Scores by the first point of a cluster: what a claim leaves as it was is not scored again.
    scored: dict[int, tuple[np.ndarray, float]] = {}
    if known and len(free):
        clusters = _group_by_label(label[voxel])
        scored = {int(group[0]): (group, person_score(local[group], floor)) for _, group in clusters}
        whole = {number for number, group in clusters if scored[int(group[0])][1] >= settings.min_score}
        label[free] = assign_to_known(centres[free] + origin, label[free], known, whole)
    people = []
    for number, group in _group_by_label(label[voxel]):
        owner = int(number - new_clusters) if number >= new_clusters else None
        before, score = scored.get(int(group[0]), (group[:0], 0.0))
        if not np.array_equal(before, group):
            score = person_score(local[group], floor)
        if len(group) >= settings.min_points and (owner is not None or score >= settings.min_score):
            chosen = rows[group]
            own_normals = None if normals is None else normals[chosen]
            people.append(PersonCloud(points[chosen], own_normals, rows=chosen, score=score, owner=owner))
    people.sort(key=lambda person: (person.owner is None, -person.score))
    return people[: settings.max_people]


def assign_to_known(centres: np.ndarray, label: np.ndarray, known: Sequence[np.ndarray], whole: Set[int]) -> np.ndarray:
    """Return the labels (M,) of voxel centres (M, 3), those of the k-th known body as the first free label + k.

    A body takes a cluster that it explains for the most part, or that is a `whole` person even where its prediction
    lags behind, and of any other cluster the points near it. Clusters with several bodies are divided by the nearest
    body.
    """
    trees = [cKDTree(points) for points in known]
    distance = np.full((len(known), len(centres)), np.inf)
    for own, tree in zip(distance, trees, strict=True):
        if tree.n:
            inside = (centres > tree.mins - MAX_OWN_DISTANCE_M) & (centres < tree.maxes + MAX_OWN_DISTANCE_M)
            near = np.flatnonzero(inside.all(axis=1))
            own[near] = tree.query(centres[near])[0]
    nearest, closest = distance.argmin(axis=0), distance.min(axis=0)
    assigned, first = label.copy(), int(label.max()) + 1
    for number, group in _group_by_label(label):
        near = group[closest[group] < MAX_OWN_DISTANCE_M]
        share = np.bincount(nearest[near], minlength=len(known)) / len(group)
        owners = np.flatnonzero(share > MIN_CLAIM_SHARE)
        if not len(owners):
            continue
        taken = group if share.sum() > MIN_WHOLE_SHARE or number in whole else near
        away = np.stack([trees[owner].query(centres[taken])[0] for owner in owners])
        assigned[taken] = first + owners[away.argmin(axis=0)]
    return assigned


def person_score(points: np.ndarray, floor: Plane | None) -> float:
    """Return how much (0 to 1) a cluster (N, 3) in metres is like a person by extents, flatness and height."""
    if len(points) < 3:
        return 0.0
    middle = points.mean(axis=0)
    axes = np.linalg.svd((points - middle).T @ (points - middle))[0]
    extents = np.ptp(np.percentile((points - middle) @ axes, (2, 98), axis=0), axis=0)
    score = 1.0
    for extent, limits in zip(extents, EXTENT_LIMITS_M, strict=True):
        score *= float(np.interp(extent, limits, (0.0, 1.0, 1.0, 0.0)))
    if score > 0:
        score *= float(np.interp(_flat_share(points), FLAT_SHARE_LIMITS, (1.0, 0.0)))
    if floor is not None:
        score *= float(np.interp(np.percentile(floor.height(points), 2), FLOOR_GAP_LIMITS_M, (1.0, 0.0)))
    return score


def _flat_share(points: np.ndarray) -> float:
    """Return the share (0 to 1) of 200 points that lie on three planes at right angles, as those of furniture do."""
    places = points[np.linspace(0, len(points) - 1, min(200, len(points))).astype(np.int64)]
    spread = points[:: max(1, len(points) // 2000)]
    near = spread[cKDTree(spread).query(places, k=min(12, len(spread)))[1]]
    near = near - near.mean(axis=1, keepdims=True)
    normals = np.linalg.svd(near.transpose(0, 2, 1) @ near)[0][:, :, 2]
    cosine = np.abs(normals @ normals.T)
    first = int((cosine > MIN_PARALLEL_COSINE).sum(axis=0).argmax())
    square = np.where(cosine[first] < MAX_SQUARE_COSINE, (cosine > MIN_PARALLEL_COSINE).sum(axis=0), -1)
    second = int(square.argmax())
    third = np.abs(normals @ np.cross(normals[first], normals[second]))
    return float(
        (
            (cosine[first] > MIN_PARALLEL_COSINE)
            | (cosine[second] > MIN_PARALLEL_COSINE)
            | (third > MIN_PARALLEL_COSINE)
        ).mean()
    )


def _compensate_range(points: np.ndarray) -> np.ndarray:
    """Move points (N, 3) beyond `MAX_GAP_RANGE_M` towards the sensor at 0, to undo the widening of its grid of rays."""
    distance = np.linalg.norm(points, axis=1, keepdims=True)
    far = np.maximum(distance / MAX_GAP_RANGE_M, 1.0)
    return points * (1 + np.log(far)) / far


def _find_voxels(points: np.ndarray, size: float) -> np.ndarray:
    """Return the number (N,) of the occupied voxel that each point lies in."""
    cells = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    shape = cells.max(axis=0) + 1
    return np.unique(np.ravel_multi_index(tuple(cells.T), tuple(shape)), return_inverse=True)[1]


def _average_voxels(points: np.ndarray, voxel: np.ndarray) -> np.ndarray:
    count = np.bincount(voxel)
    return np.stack([np.bincount(voxel, column) / count for column in points.T], axis=1)


def _remove_planes(
    centres: np.ndarray, clearance: float, origin: np.ndarray, plane_cache: PlaneCache | None
) -> tuple[np.ndarray, Plane | None]:
    """Return the indices of the voxels that are neither in or below the floor nor in walls, and the floor.

    `centres` (M, 3) are relative to `origin` (3,), which may differ from cloud to cloud.
    """
    cached = plane_cache.get(centres, clearance, origin) if plane_cache else None
    floor, walls = cached or find_planes(centres, clearance)
    if plane_cache and cached is None:
        plane_cache.put(centres, clearance, floor, walls, origin)
    return np.flatnonzero(is_clear_of_planes(centres, clearance, floor, walls)), floor


def _group_by_label(label: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """Return each label that is not negative with the indices of its points."""
    order = np.argsort(label, kind="stable")
    starts = np.flatnonzero(np.diff(label[order], prepend=-2))
    groups = np.split(order, starts[1:])
    return [(int(label[group[0]]), group) for group in groups if label[group[0]] >= 0]
