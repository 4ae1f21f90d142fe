# SPDX-License-Identifier: Apache-2.0
"""Where people may be in a scene: clusters of a person's size, and columns about head peaks of larger ones.

What touches a person joins their cluster, and in a crowd everybody is one cluster. Heads stand out: they are the local
maxima of the heights, and the upper bodies below them the densest columns. So every large cluster is cut into columns,
each point to the nearest head. Walls stay, as they tell what is beside a person; the fit rejects what is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.spatial import cKDTree

from flowing_puppet_ros.body.segmentation.floor_grid import FloorGrid
from flowing_puppet_ros.body.segmentation.linkage import link_points, thin_points
from flowing_puppet_ros.body.segmentation.people import assign_to_known

HEIGHT_LIMITS_M = (0.12, 2.2)  # over the floor, of points that may be a person's
TOP_LIMITS_M = (1.05, 2.1)  # over the floor, of the topmost point of a person
MIN_VISIBLE_HEIGHT_M = 0.35
MAX_PERSON_WIDTH_M, COLUMN_RADIUS_M = 1.25, 0.42
MIN_UPPER_M, MODE_WIDTH_M = 0.9, 0.28  # height of upper bodies, and width of the window of their densest columns
PEAK_CELL_M, PEAK_RADIUS_CELLS = 0.1, 2
MIN_PEAK_GAP_M = 0.3  # between two columns
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
    """

    rows: np.ndarray
    middle: np.ndarray
    floor: float
    top: float
    whole: bool


@dataclass(frozen=True, slots=True, eq=False)
class SceneHeights:
    """A scene's points (N, 3) m with their height (N,) over the floor and the `floor` itself."""

    points: np.ndarray
    height: np.ndarray
    floor: FloorGrid

    @classmethod
    def of(cls, points: np.ndarray) -> SceneHeights:
        """Find the floor of a scene with N > 0 finite points."""
        floor = FloorGrid.find(points)
        return cls(points, floor.height(points), floor)


def find_candidates(
    scene: SceneHeights, viewpoint: np.ndarray, min_points: int, known: Sequence[np.ndarray] = ()
) -> tuple[list[Candidate], dict[int, np.ndarray]]:
    """Find where people may be, and the points of those who are known.

    Args:
        scene: points and heights.
        viewpoint: (3,) position of the sensor, metres.
        min_points: points that a candidate needs.
        known: points (K, 3) in metres on each body that is expected in the cloud, at its predicted position.

    Returns:
        The candidates, and by the index of a known body the rows (N,) of its points, ascending.
    """
    rows = np.flatnonzero((scene.height > HEIGHT_LIMITS_M[0]) & (scene.height < HEIGHT_LIMITS_M[1]))
    if not len(rows):
        return [], {}
    thin, voxel = thin_points(np.column_stack([scene.points[rows, :2], scene.height[rows]]))
    label = link_points(thin, np.linalg.norm(thin[:, :2] - viewpoint[:2], axis=1))
    weight, by_voxel = np.bincount(voxel), _group(voxel)
    owned: dict[int, np.ndarray] = {}
    if known:
        places = (
            thin
            + np.array([0.0, 0.0, 1.0])
            * (scene.points[rows, 2] - scene.height[rows])[np.array([members[0] for members in by_voxel])][:, None]
        )
        new_labels = label.max() + 1
        label = assign_to_known(places, label, known, frozenset())
        for owner in np.unique(label[label >= new_labels]):
            members = np.flatnonzero(label == owner)
            owned[int(owner - new_labels)] = np.sort(rows[np.concatenate([by_voxel[v] for v in members])])
        label[label >= new_labels] = -1
    groups: list[tuple[np.ndarray, bool]] = []
    for members in _group(label):
        if label[members[0]] < 0:
            continue
        if weight[members].sum() < min_points or thin[members, 2].max() < TOP_LIMITS_M[0]:
            continue
        small = bool(np.hypot(*np.ptp(thin[members, :2], axis=0)) < MAX_PERSON_WIDTH_M)
        peaks = _find_columns(thin[members], weight[members])
        if small:
            groups.append((members, True))
        if not small or len(peaks) > 1:
            distance, owner = cKDTree(peaks).query(thin[members, :2]) if len(peaks) else (np.empty(0), np.empty(0))
            groups += [
                (members[(owner == number) & (distance < COLUMN_RADIUS_M)], False) for number in range(len(peaks))
            ]
    found = [_make_candidate(scene, rows, by_voxel, members, whole) for members, whole in groups if len(members)]
    return _filter_by_surroundings([c for c in found if c is not None and len(c.rows) >= min_points], scene), owned


def _make_candidate(
    scene: SceneHeights, rows: np.ndarray, by_voxel: list[np.ndarray], members: np.ndarray, whole: bool
) -> Candidate | None:
    chosen = np.sort(rows[np.concatenate([by_voxel[voxel] for voxel in members])])
    height = scene.height[chosen]
    top = float(height.max())
    if not TOP_LIMITS_M[0] < top < TOP_LIMITS_M[1] or top - height.min() < MIN_VISIBLE_HEIGHT_M:
        return None
    middle = np.median(scene.points[chosen, :2], axis=0)
    return Candidate(chosen, middle, scene.floor.locate(*middle), top, whole)


def _find_columns(points: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return places (K, 2) of heads and of the densest upper bodies in a cluster of points (M, 3): x, y, height."""
    upper = np.flatnonzero(points[:, 2] > MIN_UPPER_M)
    if not len(upper):
        return np.empty((0, 2))
    low = points[upper, :2].min(axis=0) - 5 * PEAK_CELL_M
    cell = np.floor((points[upper, :2] - low) / PEAK_CELL_M).astype(np.int64)
    shape = tuple(cell.max(axis=0) + 6)
    tops = np.zeros(shape)
    np.maximum.at(tops, tuple(cell.T), points[upper, 2])
    size = 2 * PEAK_RADIUS_CELLS + 1
    is_head = (tops > 0) & (tops >= maximum_filter(tops, size=size) - 1e-9)
    density = np.zeros(shape)
    np.add.at(density, tuple(cell.T), np.sqrt(weight[upper]))
    density = gaussian_filter(density, MODE_WIDTH_M / 2 / PEAK_CELL_M, mode="constant")
    is_mode = (density > 0.2) & (density >= maximum_filter(density, size=size) - 1e-12) & (density > 0)
    heads, modes = np.argwhere(is_head), np.argwhere(is_mode)
    order = np.argsort(-tops[tuple(heads.T)], kind="stable")
    kept: list[np.ndarray] = []
    for place in (*heads[order], *modes):
        middle = low + PEAK_CELL_M * (place + 0.5)
        if all(np.hypot(*(middle - other)) > MIN_PEAK_GAP_M for other in kept):
            kept.append(middle)
    return np.array(kept).reshape(-1, 2)


def _filter_by_surroundings(candidates: list[Candidate], scene: SceneHeights) -> list[Candidate]:
    """Drop the candidates that go on above a head's height, or that are a small part of something long."""
    if not candidates:
        return []
    tree = cKDTree(scene.points[:, :2])
    kept = []
    for candidate in candidates:
        trunk = candidate.rows[scene.height[candidate.rows] > MIN_UPPER_M]
        middle = np.median(scene.points[trunk if len(trunk) else candidate.rows, :2], axis=0)
        near = np.array(tree.query_ball_point(middle, CONTEXT_RING_M[1]), dtype=np.int64)
        height = scene.height[near]
        away = np.hypot(*(scene.points[near, :2] - middle).T)
        over = height - candidate.top
        overhead = np.sum((away < OVERHEAD_RADIUS_M) & (over > OVERHEAD_LIMITS_M[0]) & (over < OVERHEAD_LIMITS_M[1]))
        trunk_height = (height > MIN_UPPER_M) & (height < HEIGHT_LIMITS_M[1])
        ring = np.sum(trunk_height & (away > CONTEXT_RING_M[0]))
        if overhead <= MAX_OVERHEAD_SHARE * len(candidate.rows) and ring <= MAX_COLUMN_CONTEXT * max(len(trunk), 1):
            kept.append(candidate)
    return kept


def _group(label: np.ndarray) -> list[np.ndarray]:
    """Return the indices of each label."""
    order = np.argsort(label, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1) if len(label) else []
