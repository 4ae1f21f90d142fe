# SPDX-License-Identifier: Apache-2.0
"""Floors and walls of a scene: planes that are larger than a person, found by RANSAC (Fischler and Bolles 1981).

Open3D's `segment_plane` has no limits of tilt or size, so the back of a person close to a low camera could win over the
floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

MIN_TRIALS, MAX_TRIALS, TRIALS_TIMES_POINTS = 200, 3000, 2_000_000
"""RANSAC trials. Small clouds may have a small floor, and take more trials in the same time."""
MAX_TRIAL_DISTANCE_M = 1.0
"""Distance along each axis from the first point of a trial to the other two, so that small planes are hit too."""
MAX_TILT_RAD = np.radians(15.0)
"""Angle between a floor's normal and z."""
MAX_BELOW_FLOOR_SHARE = 0.03
"""Share of points that may lie below a floor: reflections and noise."""
MIN_FLOOR_SIZE_M = (1.0, 0.5)
MIN_WALL_SIZE_M = (1.8, 1.2)
"""Longer and shorter side; a wall is larger than a person, a floor may be cropped narrowly."""

CELL_M, MIN_COVERED_SHARE = 0.25, 0.6
"""Share of the product of its sides that a plane's points must cover, in cells of this size; slices through people and
furniture cover less."""

MAX_WALLS = 8  # the search for walls ends there
MAX_PLANE_POINTS = 8000  # points in which planes are looked for
MAX_CACHED_CLOUDS, MIN_KEPT_SHARE = 10, 0.7
"""Clouds after which planes are searched again, and the share of a plane's points that must still lie on it."""


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """A plane: normal . x = offset.

    Attributes:
        normal: (3,) unit vector; that of a floor points up.
        offset: metres.
    """

    normal: np.ndarray
    offset: float

    def height(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distances (N,) of points (N, 3) in metres, positive on the side of the normal."""
        return np.asarray(points @ self.normal - self.offset)

    def shift(self, step: np.ndarray) -> Plane:
        """Return the plane moved by `step` (3,) metres."""
        return Plane(self.normal, self.offset + float(self.normal @ step))


class PlaneCache:
    """The floor and walls of the last cloud of a stream, searched again only now and then or when they are gone."""

    def __init__(self, max_clouds: int = MAX_CACHED_CLOUDS) -> None:
        """Start empty; planes are searched again after `max_clouds`."""
        self._max_clouds = max_clouds
        self._planes: list[tuple[Plane, float]] = []
        self._has_floor = False
        self._clouds_left = 0

    def get(self, points: np.ndarray, clearance: float, origin: np.ndarray) -> tuple[Plane | None, list[Plane]] | None:
        """Return floor and walls fitted to points (N, 3) in metres; None when they must be searched again.

        Points and planes are relative to `origin` (3,), which may differ from cloud to cloud.
        """
        self._clouds_left -= 1
        planes = []
        for cached, share in self._planes:
            plane = cached.shift(-origin)
            on = np.abs(plane.height(points)) < clearance
            if self._clouds_left < 0 or on.mean() < MIN_KEPT_SHARE * share:
                self._clouds_left = 0
                return None
            planes.append(_fit_plane(plane, points[on])[0])
        if self._clouds_left < 0:
            return None
        floor = planes.pop(0) if self._has_floor else None
        return floor, planes

    def put(
        self, points: np.ndarray, clearance: float, floor: Plane | None, walls: Sequence[Plane], origin: np.ndarray
    ) -> None:
        """Keep the planes that were found, each with the share of the points (N, 3) that lie on it."""
        planes = [*([floor] if floor is not None else []), *walls]
        shares = [float((np.abs(plane.height(points)) < clearance).mean()) for plane in planes]
        self._planes = [(plane.shift(origin), share) for plane, share in zip(planes, shares, strict=True)]
        self._has_floor, self._clouds_left = floor is not None, self._max_clouds


def find_planes(
    points: np.ndarray, clearance: float, sensor: np.ndarray | None = None
) -> tuple[Plane | None, list[Plane]]:
    """Return the floor, None without one, and the walls in points (N, 3) m with z up, evenly downsampled.

    `clearance` is the half thickness of a plane, metres, and `sensor` (3,) m is above the floor.
    """
    rng = np.random.default_rng(0)
    floor = find_floor(subsample(points), clearance, rng, sensor)
    walls: list[Plane] = []
    while len(walls) < MAX_WALLS:
        free = points[is_clear_of_planes(points, clearance, floor, walls)]
        wall = find_wall(subsample(free), clearance, rng) if len(free) >= 3 else None
        if wall is None:
            break
        walls.append(wall)
    return floor, walls


def is_clear_of_planes(points: np.ndarray, clearance: float, floor: Plane | None, walls: Sequence[Plane]) -> np.ndarray:
    """Return which points (N,) are neither in or below the floor nor in walls."""
    clear = np.ones(len(points), dtype=bool) if floor is None else floor.height(points) > clearance
    for wall in walls:
        clear &= np.abs(wall.height(points)) > clearance
    return clear


def subsample(points: np.ndarray) -> np.ndarray:
    """Return evenly chosen points, as many as are enough to find planes."""
    return np.ascontiguousarray(points[:: 1 + len(points) // MAX_PLANE_POINTS])


def find_floor(
    points: np.ndarray,
    clearance: float,
    rng: np.random.Generator,
    sensor: np.ndarray | None = None,
    max_tilt: float = MAX_TILT_RAD,
) -> Plane | None:
    """Return the nearly level plane that most points lie on and next to none lie below, or None.

    Args:
        points: (N, 3) metres, z up, evenly downsampled.
        clearance: half thickness of the plane, metres.
        rng: source of all randomness.
        sensor: (3,) m, a place above the floor; None where nobody knows.
        max_tilt: radians, between its normal and z.
    """
    normals, offsets = _sample_planes(points, rng)
    normals, offsets = normals * np.sign(normals[:, 2:]), offsets * np.sign(normals[:, 2])
    level = normals[:, 2] > np.cos(max_tilt)
    height = points @ normals[level].T - offsets[level]
    count = (np.abs(height) < clearance).sum(axis=0)
    count[(height < -2 * clearance).mean(axis=0) > MAX_BELOW_FLOOR_SHARE] = 0
    if sensor is not None:
        count[normals[level] @ sensor < offsets[level] + clearance] = 0
    return _fit_best(points, normals[level], offsets[level], count, clearance, MIN_FLOOR_SIZE_M)


def find_wall(
    points: np.ndarray,
    thickness: float,
    rng: np.random.Generator,
    size: tuple[float, float] = MIN_WALL_SIZE_M,
) -> Plane | None:
    """Return the plane of any direction that most points (N, 3) lie on, or None when it is not of some size.

    `size` is the minimum of its longer and shorter side, metres; without it the plane is larger than a person.
    """
    normals, offsets = _sample_planes(points, rng)
    count = _count_on_planes(points, normals, offsets, thickness)
    return _fit_best(points, normals, offsets, count, thickness, size)


@njit(cache=True, nogil=True)
def _count_on_planes(points: np.ndarray, normals: np.ndarray, offsets: np.ndarray, thickness: float) -> np.ndarray:
    """Count (T,) the points (N, 3) that are nearer than `thickness` to each plane."""
    count = np.zeros(len(normals), np.int64)
    for trial in range(len(normals)):
        x, y, z, offset = normals[trial, 0], normals[trial, 1], normals[trial, 2], offsets[trial]
        on = 0
        for row in range(len(points)):
            on += abs(x * points[row, 0] + y * points[row, 1] + z * points[row, 2] - offset) < thickness
        count[trial] = on
    return count


def _sample_planes(points: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the normals (T, 3) and offsets (T,) of planes through three random points each."""
    first = points[
        rng.integers(0, len(points), int(np.clip(TRIALS_TIMES_POINTS // len(points), MIN_TRIALS, MAX_TRIALS)))
    ]
    ranks = rng.integers(0, _count_near(points, first)[:, None], (len(first), 2))
    second, third = points[_find_near(points, first, ranks).T]
    cross = np.cross(second - first, third - first)
    length = np.linalg.norm(cross, axis=1)
    kept = length > 1e-6
    normals = cross[kept] / length[kept, None]
    return normals, (normals * first[kept]).sum(axis=1)


@njit(cache=True, nogil=True)
def _count_near(points: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Count (T,) the points (N, 3) near each centre (T, 3); trials times points is bounded, so without an index."""
    count = np.zeros(len(centres), np.int64)
    for trial in range(len(centres)):
        x, y, z = centres[trial]
        near = 0
        for row in range(len(points)):
            near += _axis_distance(points, row, x, y, z) <= MAX_TRIAL_DISTANCE_M
        count[trial] = near
    return count


@njit(cache=True, nogil=True)
def _find_near(points: np.ndarray, centres: np.ndarray, ranks: np.ndarray) -> np.ndarray:
    """Return the rows (T, K) of the points with the ranks (T, K) among those near each centre (T, 3)."""
    found = np.zeros(ranks.shape, np.int64)
    for trial in range(len(centres)):
        x, y, z = centres[trial]
        near, last = 0, ranks[trial].max()
        for row in range(len(points)):
            if _axis_distance(points, row, x, y, z) <= MAX_TRIAL_DISTANCE_M:
                for k in range(ranks.shape[1]):
                    if ranks[trial, k] == near:
                        found[trial, k] = row
                near += 1
                if near > last:
                    break
    return found


@njit(cache=True, inline="always")
def _axis_distance(points: np.ndarray, row: int, x: float, y: float, z: float) -> float:
    """Return the largest of a point's three distances along the axes."""
    return max(max(abs(points[row, 0] - x), abs(points[row, 1] - y)), abs(points[row, 2] - z))


def _fit_best(
    points: np.ndarray,
    normals: np.ndarray,
    offsets: np.ndarray,
    count: np.ndarray,
    thickness: float,
    size: tuple[float, float],
) -> Plane | None:
    """Return the trial with most points, fitted to them by least squares, or None unless it is large and covered."""
    if not len(count) or count.max() < 3:
        return None
    best = int(count.argmax())
    plane = Plane(normals[best], float(offsets[best]))
    for _ in range(2):
        on = points[np.abs(plane.height(points)) < thickness]
        plane, middle, axes = _fit_plane(plane, on)
    # One piece, because the front of a cupboard and a person beside it are not a wall.
    along = _largest_piece((on - middle) @ axes[:, :2])
    # Percentiles, because single distant points must not stretch a person's back to a wall.
    longer, shorter = np.ptp(np.percentile(along, (5, 95), axis=0), axis=0)
    covered = CELL_M**2 * len(np.unique(np.floor(along / CELL_M), axis=0))
    wide = longer >= size[0] and shorter >= size[1]
    return plane if wide and covered >= MIN_COVERED_SHARE * longer * shorter else None


def _largest_piece(along: np.ndarray) -> np.ndarray:
    """Return the points (M, 2) in metres of the piece with most cells, which touch, if only at corners."""
    from scipy.ndimage import label  # loaded here: a fit of one person needs no planes

    cell = np.floor((along - along.min(axis=0)) / CELL_M).astype(np.int64)
    filled = np.zeros(cell.max(axis=0) + 1, dtype=bool)
    filled[tuple(cell.T)] = True
    pieces, _ = label(filled, np.ones((3, 3)))
    sizes = np.bincount(pieces[filled])
    return np.asarray(along[pieces[tuple(cell.T)] == sizes.argmax()])


def _fit_plane(plane: Plane, points: np.ndarray) -> tuple[Plane, np.ndarray, np.ndarray]:
    """Return the least-squares plane of points (N, 3), oriented as `plane`, their mean, and their axes as columns."""
    middle = points.mean(axis=0)
    axes = np.linalg.svd((points - middle).T @ (points - middle))[0]
    normal = axes[:, 2] * np.sign(axes[:, 2] @ plane.normal)
    return Plane(normal, float(normal @ middle)), middle, axes
