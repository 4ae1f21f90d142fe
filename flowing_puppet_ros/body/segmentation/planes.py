# SPDX-License-Identifier: Apache-2.0
"""Floors and walls of a scene: planes that are larger than a person, found by RANSAC (Fischler and Bolles 1981).

Open3D's `segment_plane` is not used: it knows no limits of tilt or size, so that the back of a person who stands close
to a low camera can win over the floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.ndimage import label

TRIALS = (200, 3000)
TRIALS_TIMES_POINTS = 2_000_000
"""Small clouds may have a small floor and take more trials in the same time."""
NEIGHBOURHOOD = 1.0
"""Metres: the three points of a trial lie at most this far apart, so that small planes are hit too."""
MAX_TILT = np.radians(15.0)
BELOW_FLOOR = 0.03
"""Share of points that may lie below a floor: reflections and noise."""
FLOOR_SIZE = (1.0, 0.5)
WALL_SIZE = (1.8, 1.2)
"""Least longer and shorter side in metres; a wall's are more than a person has, a floor may be cropped narrowly."""

CELL, COVERED = 0.25, 0.6
"""Metres, and the share of its sides' product that a plane's points must cover in cells of that size; slices through
people and furniture cover less."""

REFRESH, STILL_THERE = 10, 0.7
"""Clouds after which planes are looked for anew, and the share of a plane's points that must still lie on it."""


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """normal . x = offset.

    Attributes:
        normal: (3,) unit vector; of a floor upwards.
        offset: metres.
    """

    normal: np.ndarray
    offset: float

    def height(self, points: np.ndarray) -> np.ndarray:
        """Signed distance (N,) of points (N, 3), metres, positive where the normal points."""
        return np.asarray(points @ self.normal - self.offset)

    def moved(self, step: np.ndarray) -> Plane:
        """The plane moved by `step` (3,) metres."""
        return Plane(self.normal, self.offset + float(self.normal @ step))


class PlaneCache:
    """The floor and walls of the last cloud of a stream: looked for anew only now and then, or when they are gone."""

    def __init__(self) -> None:
        """Know nothing."""
        self._kept: list[tuple[Plane, float]] = []
        self._has_floor = False
        self._left = 0

    def get(self, points: np.ndarray, clearance: float, origin: np.ndarray) -> tuple[Plane | None, list[Plane]] | None:
        """Return floor and walls moved to where points (N, 3) in metres have them; None when to look for them.

        Points and planes are relative to `origin` (3,), which may differ from cloud to cloud.
        """
        self._left -= 1
        moved = []
        for kept, share in self._kept:
            plane = kept.moved(-origin)
            on = np.abs(plane.height(points)) < clearance
            if self._left < 0 or on.mean() < STILL_THERE * share:
                self._left = 0
                return None
            moved.append(_fitted(plane, points[on])[0])
        if self._left < 0:
            return None
        floor = moved.pop(0) if self._has_floor else None
        return floor, moved

    def put(
        self, points: np.ndarray, clearance: float, floor: Plane | None, walls: Sequence[Plane], origin: np.ndarray
    ) -> None:
        """Remember what was found, and how much of the cloud (N, 3) it is."""
        planes = [*([floor] if floor is not None else []), *walls]
        shares = [float((np.abs(plane.height(points)) < clearance).mean()) for plane in planes]
        self._kept = [(plane.moved(origin), share) for plane, share in zip(planes, shares, strict=True)]
        self._has_floor, self._left = floor is not None, REFRESH


def find_floor(points: np.ndarray, clearance: float, rng: np.random.Generator) -> Plane | None:
    """Return the nearly level plane that most points lie on while next to none lie below it, or None.

    Args:
        points: (N, 3) metres, z up, thinned evenly.
        clearance: half thickness of the plane, metres.
        rng: source of the trials.
    """
    normals, offsets = _trials(points, rng)
    normals, offsets = normals * np.sign(normals[:, 2:]), offsets * np.sign(normals[:, 2])
    level = normals[:, 2] > np.cos(MAX_TILT)
    height = points @ normals[level].T - offsets[level]
    count = (np.abs(height) < clearance).sum(axis=0)
    count[(height < -2 * clearance).mean(axis=0) > BELOW_FLOOR] = 0
    return _best(points, normals[level], offsets[level], count, clearance, FLOOR_SIZE)


def find_wall(points: np.ndarray, thickness: float, rng: np.random.Generator) -> Plane | None:
    """Return the plane of any direction that most points (N, 3) lie on, or None when none is larger than a person."""
    normals, offsets = _trials(points, rng)
    count = (np.abs(points @ normals.T - offsets) < thickness).sum(axis=0)
    return _best(points, normals, offsets, count, thickness, WALL_SIZE)


def _trials(points: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Normals (T, 3) and offsets (T,) of planes through three points each."""
    first = points[rng.integers(0, len(points), int(np.clip(TRIALS_TIMES_POINTS // len(points), *TRIALS)))]
    ranks = rng.integers(0, _near_count(points, first)[:, None], (len(first), 2))
    second, third = points[_near_of_ranks(points, first, ranks).T]
    cross = np.cross(second - first, third - first)
    length = np.linalg.norm(cross, axis=1)
    kept = length > 1e-6
    normals = cross[kept] / length[kept, None]
    return normals, (normals * first[kept]).sum(axis=1)


@njit(cache=True, nogil=True)
def _near_count(points: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """How many (T,) of the points (N, 3) are near each place (T, 3); trials times points is bounded, so no index."""
    count = np.zeros(len(centres), np.int64)
    for trial in range(len(centres)):
        x, y, z = centres[trial]
        near = 0
        for row in range(len(points)):
            near += _apart(points, row, x, y, z) <= NEIGHBOURHOOD
        count[trial] = near
    return count


@njit(cache=True, nogil=True)
def _near_of_ranks(points: np.ndarray, centres: np.ndarray, ranks: np.ndarray) -> np.ndarray:
    """Rows (T, K) of the points that are the ones of the ranks (T, K) among those near each place."""
    found = np.zeros(ranks.shape, np.int64)
    for trial in range(len(centres)):
        x, y, z = centres[trial]
        near, last = 0, ranks[trial].max()
        for row in range(len(points)):
            if _apart(points, row, x, y, z) <= NEIGHBOURHOOD:
                for k in range(ranks.shape[1]):
                    if ranks[trial, k] == near:
                        found[trial, k] = row
                near += 1
                if near > last:
                    break
    return found


@njit(cache=True, inline="always")
def _apart(points: np.ndarray, row: int, x: float, y: float, z: float) -> float:
    """The largest of a point's three distances along the axes."""
    return max(max(abs(points[row, 0] - x), abs(points[row, 1] - y)), abs(points[row, 2] - z))


def _best(
    points: np.ndarray,
    normals: np.ndarray,
    offsets: np.ndarray,
    count: np.ndarray,
    thickness: float,
    size: tuple[float, float],
) -> Plane | None:
    """The trial with most points, fitted to them by least squares, if they cover enough."""
    if not len(count) or count.max() < 3:
        return None
    best = int(count.argmax())
    plane = Plane(normals[best], float(offsets[best]))
    for _ in range(2):
        on = points[np.abs(plane.height(points)) < thickness]
        plane, middle, axes = _fitted(plane, on)
    # One piece, or the front of a cupboard and a person beside it would be a wall.
    along = _largest_piece((on - middle) @ axes[:, :2])
    # Percentiles, or single points far off would stretch a person's back to a wall.
    longer, shorter = np.ptp(np.percentile(along, (5, 95), axis=0), axis=0)
    covered = CELL**2 * len(np.unique(np.floor(along / CELL), axis=0))
    wide = longer >= size[0] and shorter >= size[1]
    return plane if wide and covered >= COVERED * longer * shorter else None


def _largest_piece(along: np.ndarray) -> np.ndarray:
    """The points (M, 2) in metres of the piece with most cells; cells that touch, also at corners, are one piece."""
    cell = np.floor((along - along.min(axis=0)) / CELL).astype(np.int64)
    filled = np.zeros(cell.max(axis=0) + 1, dtype=bool)
    filled[tuple(cell.T)] = True
    pieces, _ = label(filled, np.ones((3, 3)))
    sizes = np.bincount(pieces[filled])
    return np.asarray(along[pieces[tuple(cell.T)] == sizes.argmax()])


def _fitted(plane: Plane, points: np.ndarray) -> tuple[Plane, np.ndarray, np.ndarray]:
    """The plane of least squares through points (N, 3) that faces as `plane`, their middle, their axes by columns."""
    middle = points.mean(axis=0)
    axes = np.linalg.svd((points - middle).T @ (points - middle))[0]
    normal = axes[:, 2] * np.sign(axes[:, 2] @ plane.normal)
    return Plane(normal, float(normal @ middle)), middle, axes
