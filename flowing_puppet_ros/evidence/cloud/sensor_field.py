# SPDX-License-Identifier: Apache-2.0
"""What a sensor can know of a person: its field of view, and what stands between.

A place outside the field of view, or behind something nearer that is not the person, is unknown: a body may be there
or not. `range_image` makes the field of each person from the whole scan.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F32, F64, Bools

HIDING_DEPTH_M = 0.05
"""Depth behind something else from which on a place is hidden by it; less may be noise, or a hand on a table."""

# The arrays of a field for compiled loops: viewpoint, axes, scale, offset, bounds, limit, and 1 for a pinhole image, 2
# for one of angles, 0 for no field at all.
FieldArrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, int]
PINHOLE, ANGULAR = 1, 2
NO_FIELD: FieldArrays = (
    np.zeros(3), np.eye(3), np.zeros(2), np.zeros(2), np.zeros(4), np.zeros((0, 0), dtype=np.float32), 0,
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class SensorProjection:
    """How places become pixels: pixel = scale * coordinates + offset.

    Coordinates are right and down over forward in a pinhole image, and in an angular one the azimuth to the right of
    forward and the angle below the plane of right and forward, radians. Depth is along forward in a pinhole image, and
    the distance in an angular one.

    Attributes:
        viewpoint: (3,) metres.
        axes: (3, 3), rows right, down and forward of the sensor.
        scale: (2,) pixels.
        offset: (2,) pixels.
        kind: `PINHOLE` or `ANGULAR`.
    """

    viewpoint: F64
    axes: F64
    scale: F64
    offset: F64
    kind: int

    @classmethod
    def pinhole(cls, fx: float, fy: float, cx: float, cy: float) -> SensorProjection:
        """Return that of a rectified image in its camera's optical frame (REP-103); all in pixels."""
        return cls(np.zeros(3), np.eye(3), np.array([fx, fy]), np.array([cx, cy]), PINHOLE)

    def turn(self, rotation: F64) -> SensorProjection:
        """Return the projection of the same places in a frame that `rotation` (3, 3) leads to."""
        return replace(self, viewpoint=rotation @ self.viewpoint, axes=np.ascontiguousarray(self.axes @ rotation.T))

    def move(self, step: F64) -> SensorProjection:
        """Return the projection of the same places in a frame in which they are moved by `step` (3,) m."""
        return replace(self, viewpoint=self.viewpoint + step)

    def project(self, points: F64) -> tuple[F64, F64]:
        """Return the pixels (N, 2) and depths (N,) m of `points` (N, 3) m."""
        arrays = (self.viewpoint, self.axes, self.scale, self.offset, np.zeros(4), NO_FIELD[5], self.kind)
        return _project_all(np.ascontiguousarray(points, dtype=np.float64), arrays)


@dataclass(frozen=True, slots=True, eq=False)
class SensorField:
    """What a sensor can know of one person.

    Attributes:
        projection: how places become pixels.
        bounds: (4,) left, top, right and bottom pixel of the field of view, infinite where it has no end.
        limit: (H, W) depth of what is nearest and not the person, metres; infinite where nothing else is.
    """

    projection: SensorProjection
    bounds: F64
    limit: F32

    def find_unknown(self, points: F64) -> Bools:
        """Return which (N,) of the places `points` (N, 3) m the sensor knows nothing about."""
        return _find_unknown(np.ascontiguousarray(points, dtype=np.float64), self.arrays)

    def doubt_blanks(self, points: F64) -> SensorField:
        """Return the field of a sensor that knows nothing about pixels without depth, unless it is the person's own.

        `points` (N, 3) m are the person's. Black clothes and sunlight leave such pixels as the open air does.
        """
        return self._doubt(np.isinf(self.limit), points)

    def doubt_around(self, lines: F64, distance: float, points: F64) -> SensorField:
        """Return the field of a sensor that knows nothing within a `distance`, metres across the ray, from lines.

        `lines` (K, 2, 3) m have two ends, and `points` (N, 3) m are the person's, of which it knows. Beside a limb of
        which it has no depth it sees through, but nothing tells where the limb's outline is.
        """
        near = np.zeros(self.limit.shape, dtype=bool)
        rows, columns = np.ogrid[: near.shape[0], : near.shape[1]]
        for line in lines:
            pixels, depth = self.projection.project(line)
            if (depth <= 0).any():
                continue
            radius = distance * self.projection.scale / (depth.mean() if self.projection.kind == PINHOLE else 1.0)
            (u, v), (du, dv) = pixels[0] / radius, np.diff(pixels, axis=0)[0] / radius
            across, down = columns / radius[0] - u, rows / radius[1] - v
            along = np.clip((across * du + down * dv) / max(du * du + dv * dv, 1e-9), 0.0, 1.0)
            near |= (across - along * du) ** 2 + (down - along * dv) ** 2 < 1
        return self._doubt(near, points)

    def _doubt(self, pixels: Bools, points: F64) -> SensorField:
        """Return the field of a sensor that knows nothing about `pixels` (H, W), unless they show `points` (N, 3) m."""
        limit = np.where(pixels, np.float32(0), self.limit)
        column, row = np.floor(self.projection.project(points)[0] + 0.5).astype(np.int64).T
        inside = (column >= 0) & (row >= 0) & (column < limit.shape[1]) & (row < limit.shape[0])
        own = row[inside], column[inside]
        limit[own] = self.limit[own]
        return replace(self, limit=limit)

    @property
    def arrays(self) -> FieldArrays:
        """What compiled loops need."""
        to = self.projection
        return (to.viewpoint, to.axes, to.scale, to.offset, self.bounds, self.limit, to.kind)


@njit(cache=True, inline="always")
def project_point(x, y, z, field):  # type: ignore[no-untyped-def]
    """Return pixel (u, v) and depth of a place, for `FieldArrays`; depth 0 behind a pinhole."""
    viewpoint, axes, scale, offset, _, _, kind = field
    x, y, z = x - viewpoint[0], y - viewpoint[1], z - viewpoint[2]
    right = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z
    down = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z
    forward = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z
    if kind == PINHOLE:
        if forward <= 1e-6:
            return 0.0, 0.0, 0.0
        return scale[0] * right / forward + offset[0], scale[1] * down / forward + offset[1], forward
    level = np.sqrt(right * right + forward * forward)
    u, v = scale[0] * np.arctan2(right, forward) + offset[0], scale[1] * np.arctan2(down, level) + offset[1]
    return u, v, np.sqrt(level * level + down * down)


@njit(cache=True, inline="always")
def is_unknown(x, y, z, field):  # type: ignore[no-untyped-def]
    """Return whether a sensor with `FieldArrays` knows nothing about a place."""
    bounds, limit, kind = field[4], field[5], field[6]
    if kind == 0:
        return False
    u, v, depth = project_point(x, y, z, field)
    if depth <= 0 or u < bounds[0] or v < bounds[1] or u > bounds[2] or v > bounds[3]:
        return True
    column, row = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
    if column < 0 or row < 0 or column >= limit.shape[1] or row >= limit.shape[0]:
        return False
    return depth > limit[row, column] + HIDING_DEPTH_M


@njit(cache=True, nogil=True)
def _find_unknown(points, field):  # type: ignore[no-untyped-def]
    found = np.empty(len(points), dtype=np.bool_)
    for k in range(len(points)):
        found[k] = is_unknown(points[k, 0], points[k, 1], points[k, 2], field)
    return found


@njit(cache=True, nogil=True)
def _project_all(points, field):  # type: ignore[no-untyped-def]
    pixels, depth = np.empty((len(points), 2)), np.empty(len(points))
    for k in range(len(points)):
        pixels[k, 0], pixels[k, 1], depth[k] = project_point(points[k, 0], points[k, 1], points[k, 2], field)
    return pixels, depth
