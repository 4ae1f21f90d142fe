# SPDX-License-Identifier: Apache-2.0
"""Where people may be in a scene: clusters of a person's size, and columns about head peaks of larger ones.

What touches a person joins their cluster, and in a crowd everybody is one cluster. Heads stand out: they are the local
maxima of the heights, and the upper bodies below them the densest columns. So every large cluster is cut into columns,
each point to the nearest head. Walls stay, as they tell what is beside a person; the fit rejects what is none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from flowing_puppet_ros.body.segmentation.column_index import ColumnIndex, find_walls
from flowing_puppet_ros.body.segmentation.floor_grid import FloorGrid
from flowing_puppet_ros.body.segmentation.head_columns import MIN_UPPER_M, find_columns, find_nearest_column
from flowing_puppet_ros.body.segmentation.linkage import link_points, thin_points
from flowing_puppet_ros.body.segmentation.people import assign_to_known

HEIGHT_LIMITS_M = (0.12, 2.2)  # over the floor, of points that may be a person's
TOP_LIMITS_M = (1.05, 2.1)  # over the floor, of the topmost point of a person
MIN_LOW_TOP_M = 0.6  # the same of somebody who sits on the floor, crouches or bends
MIN_VISIBLE_HEIGHT_M = 0.35
MAX_PERSON_WIDTH_M, COLUMN_RADIUS_M = 1.25, 0.42
MAX_LOW_WIDTH_M = 1.5  # of who is low: straight legs on the floor reach far
MIN_PIECE_SHARE, PIECE_RADIUS_M, PIECE_GAP_M = 0.5, 0.35, 0.45
"""Share of a person's points that the largest piece has of somebody half hidden, distance of the other pieces from its
middle, and height above it up to which they belong to it."""
OVERHEAD_RADIUS_M, OVERHEAD_LIMITS_M, MAX_OVERHEAD_SHARE = 0.25, (0.1, 0.45), 0.1
"""Radius about a column and heights over its top at which a wall or a post goes on, and how many points may lie there
for each of the column's own; a ceiling is higher."""
CONTEXT_RING_M = (0.5, 0.95)
MAX_COLUMN_CONTEXT = 15.0
"""Ring of a column at the height of a trunk, and how often as many points as the column's own may lie in it."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """What may be a person.

    Attributes:
        rows: (N,) indices into the scene's points, ascending.
        middle: (2,) metres.
        floor: metres, z of the floor there.
        top: metres, height of the topmost point over the floor.
        whole: whether it is a whole cluster, not a column of one.
        low: whether its top is too low for somebody who stands.
    """

    rows: np.ndarray
    middle: np.ndarray
    floor: float
    top: float
    whole: bool
    low: bool = False

    @classmethod
    def of(cls, scene: SceneHeights, rows: np.ndarray) -> Candidate:
        """Make a candidate of what was found otherwise: rows (N,) of a scene, ascending, N > 0."""
        middle = _find_middle(scene.points, rows)
        return cls(rows, middle, scene.floor.locate(*middle), float(scene.height[rows].max()), True)


@dataclass(frozen=True, slots=True, eq=False)
class SceneHeights:
    """A scene's points (N, 3) m with their height (N,) over the floor, the `floor` itself, and an `index` of them.

    `wall` (N,) are those that go on above all heads.
    """

    points: np.ndarray
    height: np.ndarray
    floor: FloorGrid
    index: ColumnIndex
    wall: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, viewpoint: np.ndarray | None = None, height: float | None = None) -> SceneHeights:
        """Find the floor of N > 0 finite points, seen from `viewpoint` (3,) m, `height` m over it if known."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        level = None if viewpoint is None or height is None else float(viewpoint[2]) - height
        return cls._over(points, FloorGrid.find(points, viewpoint, level), ColumnIndex.of(points))

    def lay_below(self, viewpoint: np.ndarray, height: float) -> SceneHeights:
        """Return the same scene over a floor that it does not show, `height` m below the sensor."""
        floor = FloorGrid.find(self.points, viewpoint, float(viewpoint[2]) - height)
        return self._over(self.points, floor, self.index)

    @classmethod
    def _over(cls, points: np.ndarray, floor: FloorGrid, index: ColumnIndex) -> SceneHeights:
        height = floor.height(points)
        return cls(points, height, floor, index, find_walls(points, height))

    def take(self, rows: np.ndarray) -> SceneHeights:
        """Return the part of the scene whose points are `rows` (K,), K > 0, over the same floor."""
        points = self.points[rows]
        return SceneHeights(points, self.height[rows], self.floor, ColumnIndex.of(points), self.wall[rows])


def find_candidates(
    scene: SceneHeights,
    viewpoint: np.ndarray,
    min_points: int,
    known: Sequence[np.ndarray] = (),
    only_known: bool = False,
    low: bool = False,
) -> tuple[list[Candidate], dict[int, np.ndarray]]:
    """Find where people may be, and the points of those who are known.

    Args:
        scene: points and heights.
        viewpoint: (3,) position of the sensor, metres.
        min_points: points that a candidate needs.
        known: points (K, 3) in metres on each body that is expected in the cloud, at its predicted position.
        only_known: look near the known bodies only, and find no candidates.
        low: find also what is too low for somebody who stands; the others are the same.

    Returns:
        The candidates, and by the index of a known body the rows (N,) of its points, ascending.
    """
    inside = (scene.height > HEIGHT_LIMITS_M[0]) & (scene.height < HEIGHT_LIMITS_M[1]) & ~scene.wall
    if only_known:
        inside &= _lies_near(scene, known)
    rows = np.flatnonzero(inside)
    if not len(rows):
        return [], {}
    thin, voxel = thin_points(np.column_stack([scene.points[rows, :2], scene.height[rows]]))
    label = link_points(thin, np.linalg.norm(thin[:, :2] - viewpoint[:2], axis=1))
    weight = np.bincount(voxel)
    members = _VoxelRows(rows[np.argsort(voxel, kind="stable")], np.append(0, np.cumsum(weight)))
    owned: dict[int, np.ndarray] = {}
    if known:
        places = thin.copy()
        first = members.rows[members.first[:-1]]
        places[:, 2] += scene.points[first, 2] - scene.height[first]
        new_labels = label.max() + 1
        label = assign_to_known(places, label, known, frozenset())
        for owner in np.unique(label[label >= new_labels]):
            owned[int(owner - new_labels)] = members.gather(np.flatnonzero(label == owner))
        label[label >= new_labels] = -1
    if only_known:
        return [], owned
    groups = [group for cluster in _list_clusters(thin, label, weight, min_points) for group in cluster]
    found = [_make_candidate(scene, members.gather(chosen), whole, min_points) for chosen, whole in groups]
    if low:
        clusters = _list_low_clusters(thin, label, weight, min_points)
        found += [_make_candidate(scene, members.gather(chosen), True, min_points, low) for chosen in clusters]
    return _filter_by_surroundings([candidate for candidate in found if candidate is not None], scene), owned


def _lies_near(scene: SceneHeights, known: Sequence[np.ndarray]) -> np.ndarray:
    """Return which (N,) of the scene's points are so near to the middle of a known body that they may be its own."""
    near = np.zeros(len(scene.points), dtype=bool)
    for body in known:
        if len(body):
            near[scene.index.find_near(scene.points, body[:, :2].mean(axis=0), MAX_PERSON_WIDTH_M)[0]] = True
    return near


class _VoxelRows(NamedTuple):
    """The `rows` of a scene by voxel, and the `first` of each voxel in them."""

    rows: np.ndarray
    first: np.ndarray

    def gather(self, voxels: np.ndarray) -> np.ndarray:
        """Return the rows (N,) in some voxels (V,), ascending."""
        return np.sort(_gather(self.rows, self.first, voxels))


def _list_clusters(
    thin: np.ndarray, label: np.ndarray, weight: np.ndarray, min_points: int
) -> Iterator[list[tuple[np.ndarray, bool]]]:
    """Yield for each cluster of voxels (M, 3) that may hold people the voxels of its groups, and whether it is all.

    Who is half hidden is seen in pieces: the largest gets the pieces above and below it.
    """
    order = np.argsort(label, kind="stable")
    starts = np.append(np.flatnonzero(np.diff(label[order], prepend=-2)), len(order))
    tops, sizes = np.maximum.reduceat(thin[order, 2], starts[:-1]), np.add.reduceat(weight[order], starts[:-1])
    free = label[order[starts[:-1]]] >= 0
    large = (tops >= TOP_LIMITS_M[0]) & (sizes >= MIN_PIECE_SHARE * min_points) & free
    pieces = _Pieces.of(thin, order, starts, free & ~large)
    for number in np.flatnonzero(large):
        members = order[starts[number] : starts[number + 1]]
        groups = []
        small = bool(np.hypot(*np.ptp(thin[members, :2], axis=0)) < MAX_PERSON_WIDTH_M)
        peaks = find_columns(thin[members], weight[members])
        if small:
            groups.append((pieces.add(thin, members), True))
        if len(peaks) > small:
            owner = find_nearest_column(thin[members], peaks, COLUMN_RADIUS_M)
            near = np.flatnonzero(owner >= 0)
            near = near[np.argsort(owner[near], kind="stable")]
            cuts = np.flatnonzero(np.diff(owner[near])) + 1
            groups += [(pieces.add(thin, members[column]), False) for column in np.split(near, cuts) if len(column)]
        yield groups


def _list_low_clusters(thin: np.ndarray, label: np.ndarray, weight: np.ndarray, min_points: int) -> list[np.ndarray]:
    """Return the voxels (V,) of each cluster of voxels (M, 3) that is as wide as a person and too low to stand."""
    order = np.argsort(label, kind="stable")
    starts = np.append(np.flatnonzero(np.diff(label[order], prepend=-2)), len(order))
    tops, sizes = np.maximum.reduceat(thin[order, 2], starts[:-1]), np.add.reduceat(weight[order], starts[:-1])
    chosen = (
        (label[order[starts[:-1]]] >= 0) & (tops >= MIN_LOW_TOP_M) & (tops < TOP_LIMITS_M[0]) & (sizes >= min_points)
    )
    clusters = [order[starts[number] : starts[number + 1]] for number in np.flatnonzero(chosen)]
    return [own for own in clusters if np.hypot(*np.ptp(thin[own, :2], axis=0)) < MAX_LOW_WIDTH_M]


class _Pieces(NamedTuple):
    """The `voxels` (P,) of what is too small or too low for a person, their `places` (P, 3), and an index of these."""

    voxels: np.ndarray
    places: np.ndarray
    columns: ColumnIndex | None

    @classmethod
    def of(cls, thin: np.ndarray, order: np.ndarray, starts: np.ndarray, chosen: np.ndarray) -> _Pieces:
        """Take those of the `chosen` (C,) clusters of voxels (M, 3) that are not wider than a person."""
        extent = [
            np.maximum.reduceat(thin[order, axis], starts[:-1]) - np.minimum.reduceat(thin[order, axis], starts[:-1])
            for axis in range(2)
        ]
        narrow = chosen & (np.hypot(*extent) < MAX_PERSON_WIDTH_M)
        voxels = order[np.repeat(narrow, np.diff(starts))]
        places = np.ascontiguousarray(thin[voxels])
        return cls(voxels, places, ColumnIndex.of(places) if len(voxels) else None)

    def add(self, thin: np.ndarray, group: np.ndarray) -> np.ndarray:
        """Return a group (G,) of the voxels (M, 3) with the pieces just above it, and all below it."""
        if self.columns is None:
            return group
        near, _ = self.columns.find_near(self.places, np.median(thin[group, :2], axis=0), PIECE_RADIUS_M)
        height, low, top = self.places[near, 2], thin[group, 2].min(), thin[group, 2].max()
        return np.append(group, self.voxels[near[(height < low) | ((height > top) & (height < top + PIECE_GAP_M))]])


def _make_candidate(
    scene: SceneHeights, rows: np.ndarray, whole: bool, min_points: int, is_low: bool = False
) -> Candidate | None:
    """Make a candidate of rows (N,), unless it is too small or its top is not where people's are."""
    if len(rows) < min_points:
        return None
    low, top = _find_ends(scene.height, rows)
    least, most = (MIN_LOW_TOP_M, TOP_LIMITS_M[0]) if is_low else TOP_LIMITS_M
    if not least < top < most or top - low < MIN_VISIBLE_HEIGHT_M:
        return None
    middle = _find_middle(scene.points, rows)
    return Candidate(rows, middle, scene.floor.locate(*middle), top, whole, is_low)


def _filter_by_surroundings(candidates: list[Candidate], scene: SceneHeights) -> list[Candidate]:
    """Drop the candidates that go on above a head's height, or that are a small part of something long."""
    kept = []
    for candidate in candidates:
        trunk = candidate.rows[scene.height[candidate.rows] > MIN_UPPER_M]
        middle = _find_middle(scene.points, trunk if len(trunk) else candidate.rows)
        near, away = scene.index.find_near(scene.points, middle, CONTEXT_RING_M[1])
        overhead, ring = _count_surroundings(scene.height, scene.wall, near, away, candidate.top)
        if overhead <= MAX_OVERHEAD_SHARE * len(candidate.rows) and ring <= MAX_COLUMN_CONTEXT * max(len(trunk), 1):
            kept.append(candidate)
    return kept


@njit(cache=True, nogil=True)
def _find_ends(height, rows):  # type: ignore[no-untyped-def]
    low, high = np.inf, -np.inf
    for row in rows:
        low, high = min(low, height[row]), max(high, height[row])
    return low, high


@njit(cache=True, nogil=True)
def _find_middle(points, rows):  # type: ignore[no-untyped-def]
    """Return the median (2,) of x and of y."""
    middle, values = np.empty(2), np.empty(len(rows))
    for axis in range(2):
        for k in range(len(rows)):
            values[k] = points[rows[k], axis]
        middle[axis] = np.median(values)
    return middle


@njit(cache=True, nogil=True)
def _count_surroundings(height, wall, near, away, top):  # type: ignore[no-untyped-def]
    """Return how many of the points `near` lie over a candidate's head, and in its ring at the height of a trunk.

    A wall that somebody leans at goes on over the head, too.
    """
    overhead, ring = 0, 0
    for k in range(len(near)):
        over = height[near[k]] - top
        above = away[k] < OVERHEAD_RADIUS_M and OVERHEAD_LIMITS_M[0] < over < OVERHEAD_LIMITS_M[1]
        overhead += above and not wall[near[k]]
        ring += away[k] > CONTEXT_RING_M[0] and MIN_UPPER_M < height[near[k]] < HEIGHT_LIMITS_M[1]
    return overhead, ring


@njit(cache=True, nogil=True)
def _gather(rows, first, voxels):  # type: ignore[no-untyped-def]
    room = 0
    for voxel in voxels:
        room += first[voxel + 1] - first[voxel]
    found, count = np.empty(room, np.int64), 0
    for voxel in voxels:
        for k in range(first[voxel], first[voxel + 1]):
            found[count] = rows[k]
            count += 1
    return found
