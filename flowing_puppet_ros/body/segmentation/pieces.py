# SPDX-License-Identifier: Apache-2.0
"""The pieces of a scan that lie apart: several people in one file, or one person and stray points; in any unit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from flowing_puppet_ros.body.scans.scan import Scan

MAX_PIECE_POINTS = 5000  # points by which pieces are found
GAP_EXTENTS, GAP_SPACINGS = 0.04, 3.0
"""Gap between pieces, in longest sides of the cloud and in distances to the nearest point (95th percentile)."""
EXTENT_PERCENTILES = (2, 98)
MIN_LARGE_SHARE = 0.15  # of the points, in a piece that may be a person
MAX_STRAY_SHARE, MIN_STRAY_DISTANCE = 0.005, 0.1
"""Share of the points and distance from the rest, in its longest sides, of a piece that is stray points."""
MIN_SHARED_HEIGHT, MIN_UPRIGHT_EXTENT, MIN_APART = 0.6, 0.8, 0.2
"""Share of both pieces' heights that upright people side by side have in common, height at least, and distance between
their middles, both in longest sides."""


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """A scan without stray points, and its large pieces.

    Attributes:
        scan: without stray points.
        large: pieces with much of the surface, largest first; empty when there is only one.
        are_people: whether they may be people side by side.
    """

    scan: Scan
    large: list[Scan]
    are_people: bool


def split_pieces(scan: Scan) -> Pieces:
    """Split a scan where it has gaps, and a mesh also where its faces do not connect."""
    rng = np.random.default_rng(0)
    sampled = scan.sample_surface(MAX_PIECE_POINTS, rng)[0]
    points = sampled[rng.permutation(len(sampled))[:MAX_PIECE_POINTS]]
    label = _cluster_by_gaps(points)
    share = np.bincount(label) / len(label)
    main = points[label == share.argmax()]
    longest = float(np.ptp(main, axis=0).max())
    tree = cKDTree(points[np.isin(label, np.flatnonzero(share > MAX_STRAY_SHARE))])
    stray = [
        number
        for number in np.flatnonzero(share <= MAX_STRAY_SHARE)
        if tree.query(points[label == number])[0].min() > MIN_STRAY_DISTANCE * longest
    ]
    nearest = label[cKDTree(points).query(scan.points)[1]]
    kept = scan if not stray else _take(scan, ~np.isin(nearest, stray))
    large = [
        _take(scan, nearest == number)
        for number in np.argsort(-share, kind="stable")
        if share[number] >= MIN_LARGE_SHARE
    ]
    if len(large) < 2 and scan.faces is not None:
        large = _split_faces(scan)
    large = large if len(large) > 1 else []
    return Pieces(kept, large, bool(large) and all(_stand_side_by_side(large[0], other) for other in large[1:]))


def _cluster_by_gaps(points: np.ndarray) -> np.ndarray:
    """Return the cluster (N,) of each point (N, 3)."""
    tree = cKDTree(points)
    extent = float(np.ptp(np.percentile(points, EXTENT_PERCENTILES, axis=0), axis=0).max())
    spacing = float(np.percentile(tree.query(points, k=min(2, len(points)))[0].reshape(len(points), -1)[:, -1], 95))
    pairs = tree.query_pairs(max(GAP_EXTENTS * extent, GAP_SPACINGS * spacing), output_type="ndarray")
    return _label_connected(pairs, len(points))


def _split_faces(scan: Scan) -> list[Scan]:
    """Return the parts of a mesh whose faces connect and whose middles lie apart, the largest first."""
    faces = scan.faces
    assert faces is not None
    same = np.unique(scan.points, axis=0, return_inverse=True)[1].reshape(-1)
    pairs = np.concatenate([same[faces[:, [0, 1]]], same[faces[:, [1, 2]]]])
    label = _label_connected(pairs, int(same.max()) + 1)[same]
    share = np.bincount(label[faces[:, 0]]) / len(faces)
    found = [_take(scan, label == number) for number in np.argsort(-share) if share[number] >= MIN_LARGE_SHARE]
    return found if all(_are_apart(found[0], other) for other in found[1:]) else found[:1]


def _label_connected(pairs: np.ndarray, count: int) -> np.ndarray:
    graph = coo_matrix((np.ones(len(pairs), dtype=np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


def _take(scan: Scan, chosen: np.ndarray) -> Scan:
    """Return the part of a scan with the chosen points (N,) bool and the faces that have no other."""
    if scan.faces is None:
        normals = None if scan.normals is None else scan.normals[chosen]
        return Scan(scan.points[chosen], None, normals, scan.viewpoint)
    faces = scan.faces[chosen[scan.faces].all(axis=1)]
    used, compact = np.unique(faces, return_inverse=True)
    return Scan(scan.points[used], compact.reshape(-1, 3).astype(np.int64))


def _are_apart(first: Scan, second: Scan) -> bool:
    longest = max(float(np.ptp(scan.points, axis=0).max()) for scan in (first, second))
    middles = [(scan.points.min(axis=0) + scan.points.max(axis=0)) / 2 for scan in (first, second)]
    return bool(np.linalg.norm(middles[0] - middles[1]) > MIN_APART * longest)


def _stand_side_by_side(first: Scan, second: Scan) -> bool:
    """Return whether two pieces lie apart and have most of their extent along an axis, a long one, in common."""
    low = [scan.points.min(axis=0) for scan in (first, second)]
    high = [scan.points.max(axis=0) for scan in (first, second)]
    shared = (np.minimum(*high) - np.maximum(*low)) / (np.maximum(*high) - np.minimum(*low))
    extent = np.ptp(first.points, axis=0)
    return bool(shared[extent >= MIN_UPRIGHT_EXTENT * extent.max()].max() > MIN_SHARED_HEIGHT) and _are_apart(
        first, second
    )
