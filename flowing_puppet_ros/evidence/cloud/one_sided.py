# SPDX-License-Identifier: Apache-2.0
"""What a cloud seen from one viewpoint says about a body: surface, free space and unknown space.

A point of the body may lie on the seen surface or anywhere behind it. It must not lie in front of it, nor beside the
silhouette, because the sensor saw through there. The cloud is its own depth image: directions are looked up in a grid
of the nearest seen directions, whose spacing comes from the cloud. The rings of a LiDAR may lie ten times as far apart
as the points along them: then directions are compressed across the rings, so that the gaps between these are not taken
for places where the sensor saw through. Where the sensor's field says that nothing can be known, the cloud says nothing
either.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from flowing_puppet_ros.evidence.cloud.data_term import fill_nearest
from flowing_puppet_ros.evidence.cloud.neighbours import find_neighbours
from flowing_puppet_ros.evidence.cloud.sensor_field import NO_FIELD, FieldArrays, SensorField, is_unknown

MAX_CELLS = 60_000  # of the grid of directions
SPACING_NEIGHBOUR = 4  # the spacing of directions is the distance to this neighbour ...
SPACING_PERCENTILE = 90  # ... at this percentile over the cloud, or so many points of it
MAX_SPACING_POINTS = 1000
MAX_GAP_PAIRS, MIN_STRETCH, MAX_STRETCH = 200_000, 3.0, 8.0
"""Pairs of points of which the gaps down and across are measured, about, at most, and their ratio from which on, and up
to which, it counts."""
TOLERANCE_SPACINGS = 1.5
"""Spacings of the seen directions beyond which a direction is beside the silhouette."""
MAX_DISTANCE_M = 0.15
"""Distance at which costs saturate."""
OCCLUSION_DEPTH_M = 0.05
"""Depth behind the seen surface from which a point facing the sensor counts as occluded by another part."""


# The fields of a `OneSidedView`, for compiled loops.
ViewArrays = tuple[
    np.ndarray, np.ndarray, float, np.ndarray, np.ndarray, float, np.ndarray, float, np.ndarray, FieldArrays
]


@dataclass(frozen=True, slots=True, eq=False)
class OneSidedView:
    """A cloud as its sensor saw it.

    Attributes:
        viewpoint: (3,) metres.
        axes: (3, 3), rows right, down and forward, forward towards the middle of the cloud.
        stretch: gap between the cloud's points down over that to the right; 1 where they are much the same.
        directions: (N, 2) right, and down over `stretch`, over forward of the cloud's points.
        depth: (N,) metres along forward; negative for directions in which nothing is known.
        tolerance: distance between directions beyond which one is beside the silhouette.
        low: (2,) centre of the first cell, as directions.
        cell: edge of a cell, as directions.
        nearest: (w, h) int32, index of the point seen nearest to the cell's centre.
        field: what the sensor can know, None where it sees everything.
    """

    viewpoint: np.ndarray
    axes: np.ndarray
    stretch: float
    directions: np.ndarray
    depth: np.ndarray
    tolerance: float
    low: np.ndarray
    cell: float
    nearest: np.ndarray
    field: SensorField | None = None

    @classmethod
    def build(
        cls,
        points: np.ndarray,
        viewpoint: np.ndarray,
        unknown: np.ndarray | None = None,
        field: SensorField | None = None,
    ) -> OneSidedView:
        """Index a cloud `points` (N, 3) m, seen from `viewpoint` (3,) m, which lies outside of it.

        `unknown` (K, 3) m are places in whose directions the sensor saw nothing of what lies behind them. `field` is
        what the sensor can know of what is in the cloud.
        """
        axes = _axes(points.mean(axis=0) - viewpoint)
        directions, depth = _project(points, viewpoint, axes)
        stretch = _measure_stretch(directions)
        squeeze = np.array([1.0, 1.0 / stretch])
        directions *= squeeze
        every = 1 + len(points) // MAX_SPACING_POINTS
        near = find_neighbours(np.pad(directions, ((0, 0), (0, 1))), SPACING_NEIGHBOUR + 1, every)
        apart = np.linalg.norm(directions[near] - directions[::every, None], axis=2).max(axis=1)
        spacing = float(np.percentile(apart, SPACING_PERCENTILE))
        low, high = directions.min(axis=0) - 4 * spacing, directions.max(axis=0) + 4 * spacing
        cell = max(spacing / 2, float(np.sqrt(np.prod(high - low) / MAX_CELLS)))
        shape = np.ceil((high - low) / cell).astype(np.int64) + 1
        if unknown is not None and len(unknown):
            directions = np.concatenate([directions, _project(unknown, viewpoint, axes)[0] * squeeze])
            depth = np.concatenate([depth, np.full(len(unknown), -1.0)])
        inside = np.flatnonzero(((directions >= low) & (directions <= high)).all(axis=1))
        level = np.pad(directions[inside], ((0, 0), (0, 1)))
        nearest = inside[fill_nearest(level, np.append(low, 0.0), cell, np.append(shape, 1))[:, :, 0]].astype(np.int32)
        tolerance = TOLERANCE_SPACINGS * spacing
        nearest = np.ascontiguousarray(nearest)
        return cls(viewpoint, axes, stretch, directions, depth, tolerance, low, cell, nearest, field)

    @property
    def viewpoints(self) -> np.ndarray:
        """Where the sensor is, (1, 3) m, as of several."""
        return self.viewpoint[None]

    def compare(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where `points` (N, 3) m lie relative to the seen surface.

        Returns:
            (N, 3) vectors in metres, at a right angle to the ray, by which points are beside the silhouette, zero
            inside of it; and (N,) metres along forward by which they are behind the surface, negative in front of it,
            infinite where nothing is known.
        """
        beside, behind = _compare(np.ascontiguousarray(points, dtype=np.float64), self.arrays)
        return beside, behind

    def find_hidden(self, points: np.ndarray) -> np.ndarray:
        """Return which of `points` (N, 3) m lie so far behind the seen surface that it hides them, (N,) bool."""
        return np.asarray(_find_hidden(np.ascontiguousarray(points, dtype=np.float64), self.arrays))

    def find_seen(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return which of `points` (N, 3) m with outward `normals` (N, 3) face the sensor and are not hidden, (N,)."""
        points, normals = (np.ascontiguousarray(each, dtype=np.float64) for each in (points, normals))
        return np.asarray(_find_seen(points, normals, self.arrays))

    def misfit(self, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean distance by which surface points contradict the view, for many sets of points at once.

        Args:
            points: (P, K, 3) metres.
            normals: (P, K, 3) unit normals.

        Returns:
            (P,) metres, and (P, K) bool, which points face the sensor. A point beside the silhouette or in front of the
            surface costs its distance, at most 15 cm; one behind the surface costs its depth, at most 5 cm, if it faces
            the sensor, and nothing otherwise; one outside the field costs 5 cm if it faces the sensor.
        """
        return _misfit(np.ascontiguousarray(points), np.ascontiguousarray(normals), *self.arrays)

    @property
    def arrays(self) -> ViewArrays:
        """What compiled loops need, see `compare_point`."""
        return (
            self.viewpoint, self.axes, self.stretch, self.directions, self.depth, self.tolerance, self.low, self.cell,
            self.nearest, NO_FIELD if self.field is None else self.field.arrays,
        )  # fmt: skip


def _measure_stretch(directions: np.ndarray) -> float:
    """Return the gap between `directions` (N, 2) down over that to the right.

    It is 1 where they are much the same, as in a depth image, and above 1 for the rings of a LiDAR.
    """
    across, down = _find_gaps(directions, 1 + len(directions) ** 2 // MAX_GAP_PAIRS)
    ratio = float(np.median(down) / max(float(np.median(across)), 1e-9))
    ratio = 1.0 if not np.isfinite(ratio) or 1 / MIN_STRETCH < ratio < MIN_STRETCH else ratio
    return float(np.clip(ratio, 1 / MAX_STRETCH, MAX_STRETCH))


# No NaN is compared, so that the smallest of many is found several at a time.
@njit(cache=True, nogil=True, fastmath={"nnan", "nsz", "reassoc"})
def _find_gaps(directions, every):  # type: ignore[no-untyped-def]
    """Return the distances (M,) from every such direction to the next one to its sides, and to the next up or down."""
    count = (len(directions) + every - 1) // every
    across, down, none = np.empty(count), np.empty(count), np.inf
    x, y = directions[:, 0].copy(), directions[:, 1].copy()
    for number in range(count):
        own_x, own_y, nearest_across, nearest_down = x[number * every], y[number * every], none, none
        for k in range(len(x)):
            dx, dy = abs(x[k] - own_x), abs(y[k] - own_y)
            squared = dx * dx + dy * dy
            nearest_across = min(nearest_across, squared if dx > dy else none)
            nearest_down = min(nearest_down, none if dx > dy or dy == 0.0 else squared)
        across[number], down[number] = np.sqrt(nearest_across), np.sqrt(nearest_down)
    return across, down


def distances(targets: np.ndarray, points: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """Return the distance (P, M) m of every target to the nearest allowed point of each set, at most 15 cm.

    `targets` (M, 3) m, `points` (P, K, 3) m, `allowed` (P, K) bool.
    """
    return _distances(np.ascontiguousarray(targets), np.ascontiguousarray(points), allowed)


def mean_distance(points: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return the mean distance (P,) m of `points` (P, K, 3) m to the nearest `targets` (M, 3) m, capped at 15 cm."""
    return _mean_distance(np.ascontiguousarray(points), np.ascontiguousarray(targets))


def _axes(forward: np.ndarray) -> np.ndarray:
    forward = forward / max(float(np.linalg.norm(forward)), 1e-9)
    right = np.cross(forward, (0.0, 0.0, 1.0) if abs(forward[2]) < 0.9 else (1.0, 0.0, 0.0))
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def _project(points: np.ndarray, viewpoint: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    local = (points - viewpoint) @ axes.T
    depth = np.maximum(local[:, 2], 1e-6)
    return np.ascontiguousarray(local[:, :2] / depth[:, None]), depth


@njit(cache=True, inline="always")
def _look_up(x, y, z, viewpoint, axes, stretch, directions, tolerance, low, cell, nearest):  # type: ignore[no-untyped-def]
    """Return the index of the point seen nearest in direction, depth, and the offset (x, y) beside the silhouette."""
    x, y, z = x - viewpoint[0], y - viewpoint[1], z - viewpoint[2]
    depth = max(axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z, 1e-6)
    right = (axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z) / depth
    down = (axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z) / (depth * stretch)
    i = min(max(int(np.floor((right - low[0]) / cell + 0.5)), 0), nearest.shape[0] - 1)
    j = min(max(int(np.floor((down - low[1]) / cell + 0.5)), 0), nearest.shape[1] - 1)
    found = nearest[i, j]
    dx, dy = right - directions[found, 0], down - directions[found, 1]
    apart = np.sqrt(dx * dx + dy * dy)
    share = (1 - tolerance / apart) * depth if apart > tolerance else 0.0
    return found, depth, share * dx, share * dy * stretch


@njit(cache=True, inline="always")
def compare_point(x, y, z, view):  # type: ignore[no-untyped-def]
    """Return where a place lies relative to the seen surface, for `OneSidedView.arrays`.

    Metres beside the silhouette along the view's axes right and down, and metres behind the surface as in `compare`.
    """
    viewpoint, axes, stretch, directions, seen, tolerance, low, cell, nearest, field = view
    if is_unknown(x, y, z, field):
        return 0.0, 0.0, np.inf
    found, depth, dx, dy = _look_up(x, y, z, viewpoint, axes, stretch, directions, tolerance, low, cell, nearest)
    if seen[found] < 0:
        return 0.0, 0.0, np.inf
    return dx, dy, depth - seen[found]


@njit(cache=True, nogil=True)
def _compare(points, view):  # type: ignore[no-untyped-def]
    beside, behind = np.zeros((len(points), 3)), np.empty(len(points))
    axes = view[1]
    for k in range(len(points)):
        dx, dy, behind[k] = compare_point(points[k, 0], points[k, 1], points[k, 2], view)
        for axis in range(3):
            beside[k, axis] = dx * axes[0, axis] + dy * axes[1, axis]
    return beside, behind


@njit(cache=True, nogil=True)
def _find_hidden(points, view):  # type: ignore[no-untyped-def]
    hidden = np.empty(len(points), dtype=np.bool_)
    for k in range(len(points)):
        dx, dy, behind = compare_point(points[k, 0], points[k, 1], points[k, 2], view)
        hidden[k] = behind > OCCLUSION_DEPTH_M and dx == 0 and dy == 0
    return hidden


@njit(cache=True, nogil=True)
def _find_seen(points, normals, view):  # type: ignore[no-untyped-def]
    viewpoint, sees = view[0], np.zeros(len(points), dtype=np.bool_)
    for k in range(len(points)):
        toward = 0.0
        for axis in range(3):
            toward += (viewpoint[axis] - points[k, axis]) * normals[k, axis]
        if toward > 0:
            dx, dy, behind = compare_point(points[k, 0], points[k, 1], points[k, 2], view)
            sees[k] = behind <= OCCLUSION_DEPTH_M or dx != 0 or dy != 0
    return sees


@njit(cache=True, nogil=True)
def _misfit(points, normals, viewpoint, axes, stretch, directions, seen, tolerance, low, cell, nearest, field):  # type: ignore[no-untyped-def]
    cost, facing = np.zeros(len(points)), np.zeros(points.shape[:2], dtype=np.bool_)
    for p in range(len(points)):
        for k in range(points.shape[1]):
            x, y, z = points[p, k, 0], points[p, k, 1], points[p, k, 2]
            toward = 0.0
            for axis in range(3):
                toward += (viewpoint[axis] - points[p, k, axis]) * normals[p, k, axis]
            facing[p, k] = toward > 0
            if is_unknown(x, y, z, field):
                # As what is hidden costs: a limb is no more probably out of sight than behind another.
                cost[p] += OCCLUSION_DEPTH_M if facing[p, k] else 0.0
                continue
            found, depth, dx, dy = _look_up(
                x, y, z, viewpoint, axes, stretch, directions, tolerance, low, cell, nearest
            )
            if seen[found] < 0:
                continue
            behind = depth - seen[found]
            beside = np.sqrt(dx * dx + dy * dy)
            if beside > 0:
                cost[p] += min(beside, MAX_DISTANCE_M)
            elif behind < 0:
                cost[p] += min(-behind, MAX_DISTANCE_M)
            elif facing[p, k]:
                cost[p] += min(behind, OCCLUSION_DEPTH_M)
        cost[p] /= points.shape[1]
    return cost, facing


# Both loops run over an array of the smallest squares so far, which the compiler turns into vector instructions; a loop
# that keeps one smallest number takes several times as long.
@njit(cache=True, nogil=True)
def _distances(targets, points, allowed):  # type: ignore[no-untyped-def]
    result = np.empty((len(points), len(targets)))
    x, y, z = targets[:, 0].copy(), targets[:, 1].copy(), targets[:, 2].copy()
    for p in range(len(points)):
        best = result[p]
        best[:] = MAX_DISTANCE_M * MAX_DISTANCE_M
        for k in range(points.shape[1]):
            if allowed[p, k]:
                _lower_to(best, x, y, z, points[p, k, 0], points[p, k, 1], points[p, k, 2])
        for m in range(len(targets)):
            best[m] = np.sqrt(best[m])
    return result


@njit(cache=True, nogil=True)
def _mean_distance(points, targets):  # type: ignore[no-untyped-def]
    result = np.zeros(len(points))
    best = np.empty(points.shape[1])
    for p in range(len(points)):
        x, y, z = points[p, :, 0].copy(), points[p, :, 1].copy(), points[p, :, 2].copy()
        best[:] = MAX_DISTANCE_M * MAX_DISTANCE_M
        for m in range(len(targets)):
            _lower_to(best, x, y, z, targets[m, 0], targets[m, 1], targets[m, 2])
        for k in range(points.shape[1]):
            result[p] += np.sqrt(best[k])
        result[p] /= points.shape[1]
    return result


@njit(cache=True, nogil=True)
def _lower_to(best, x, y, z, a, b, c):  # type: ignore[no-untyped-def]
    """Lower the squares `best` (M,) to the squared distances of places (x, y, z) (M,) to the point (a, b, c)."""
    for m in range(len(best)):
        dx, dy, dz = a - x[m], b - y[m], c - z[m]
        squared = dx * dx + dy * dy + dz * dz
        best[m] = squared if squared < best[m] else best[m]
