# SPDX-License-Identifier: Apache-2.0
"""Directions in which nothing is known of a person: outside of the image, and behind what stands in front."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from flowing_puppet_ros.arrays import F64, Bools

HIDING_DISTANCE_M = 0.05
"""In front of a person's nearest point by direction, from which on something else hides what is behind it."""
MAX_HIDING_POINTS = 3000
MARGIN = 0.5
"""To every side of a person, in sizes of the person, where it matters what is hidden."""
RING_STEPS = 160  # places along each side of the image's border


@dataclass(frozen=True, slots=True, eq=False)
class ViewField:
    """The field of view of a camera at the origin: a rectangle on the plane ahead at depth 1.

    Attributes:
        axes: (3, 3), rows right, down and forward.
        low, high: (2,) right and down over forward.
    """

    axes: F64
    low: F64
    high: F64

    @classmethod
    def of(cls, points: F64, axes: F64) -> ViewField:
        """Return the rectangle that the points (N, 3) m of a whole image fill."""
        plane = _project(points, axes)[0]
        return cls(axes, plane.min(axis=0), plane.max(axis=0))

    def find_unknown(self, points: F64, own: Bools, ignored: Bools) -> F64:
        """Return places (K, 3) m in whose directions nothing is known of a person.

        Args:
            points: (N, 3) m, the whole cloud.
            own: (N,) the person's.
            ignored: (N,) those that hide nobody, such as the floor's.
        """
        plane, depth = _project(points[own], self.axes)
        low, high = plane.min(axis=0), plane.max(axis=0)
        margin = MARGIN * (high - low)
        other, other_depth = _project(points, self.axes)
        near = ~own & ~ignored & ((other > low - margin) & (other < high + margin)).all(axis=1)
        rows = np.flatnonzero(near)
        nearest = cKDTree(plane).query(other[rows])[1]
        hiding = rows[other_depth[rows] < depth[nearest] - HIDING_DISTANCE_M]
        hiding = hiding[:: 1 + len(hiding) // MAX_HIDING_POINTS]
        return np.concatenate([points[hiding], self._list_border(float(np.median(depth)))])

    def _list_border(self, depth: float) -> F64:
        """Return places (K, 3) m along the border of the image, just outside of it, at a depth in metres."""
        step = (self.high - self.low) / RING_STEPS
        low, high = self.low - step, self.high + step
        across, down = (np.linspace(low[k], high[k], RING_STEPS + 3) for k in (0, 1))
        sides = [
            *(np.stack([across, np.full(len(across), y)], axis=1) for y in (low[1], high[1])),
            *(np.stack([np.full(len(down), x), down], axis=1) for x in (low[0], high[0])),
        ]
        plane = np.concatenate(sides)
        return depth * np.concatenate([plane, np.ones((len(plane), 1))], axis=1) @ self.axes


def _project(points: F64, axes: F64) -> tuple[F64, F64]:
    local = points @ axes.T
    depth = np.maximum(local[:, 2], 1e-6)
    return local[:, :2] / depth[:, None], depth
