# SPDX-License-Identifier: Apache-2.0
"""A cloud as a calibrated camera sees it: each point with its pixel, whichever sensor measured it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from flowing_puppet_ros.arrays import F64, Bools
from flowing_puppet_ros.multiview.camera import Camera

# Cells, in pixels, within which the nearest point hides those behind it where camera and sensor stand apart.
HIDING_CELL_PX = 6.0
HIDING_DEPTH_M = 0.25
MAX_SAME_PLACE_M = 0.005  # between camera and sensor that see the same


@dataclass(frozen=True, eq=False)
class SeenCloud:
    """A cloud and its pixels.

    Attributes:
        points: (N, 3) metres, z up.
        pixels: (N, 2) in the camera's image, NaN for points that it does not see.
        depth: (N,) metres along the camera's axis.
        camera: projects points of this frame.
        in_view: (N,) whether each lies in the camera's field of view, hidden by others or not.
        viewpoint: (3,) metres, where the sensor is.
    """

    points: F64
    pixels: F64
    depth: F64
    camera: Camera
    in_view: Bools
    viewpoint: F64 = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def of(cls, points: F64, camera: Camera, viewpoint: F64 | None = None) -> SeenCloud:
        """Project a cloud `points` (N, 3) m; what others hide from the camera is unseen.

        The sensor is at `viewpoint` (3,) m, or at the origin.
        """
        viewpoint = np.zeros(3) if viewpoint is None else viewpoint
        pixels, depth = camera.project(points)
        width, height = camera.size
        with np.errstate(invalid="ignore"):
            x, y = pixels[:, 0], pixels[:, 1]
            inside = (x >= -0.5) & (y >= -0.5) & (x < width - 0.5) & (y < height - 0.5)
        seen = inside.copy()
        if np.linalg.norm(camera.centre - viewpoint) > MAX_SAME_PLACE_M:
            seen[inside] = _find_unhidden(pixels[inside], depth[inside])
        return cls(points, np.where(seen[:, None], pixels, np.nan), depth, camera, inside, viewpoint)

    @property
    def seen(self) -> Bools:
        """Which points (N,) the camera sees."""
        return np.isfinite(self.pixels[:, 0])

    @cached_property
    def rectangle(self) -> tuple[F64, F64]:
        """The lowest (2,) and the highest (2,) pixels of the points that the camera sees; infinite without any."""
        pixels = self.pixels[self.seen]
        if not len(pixels):
            return np.full(2, -np.inf), np.full(2, np.inf)
        # Column by column: NumPy takes several times longer for rows of two.
        low, high = ([float(side(column)) for column in pixels.T] for side in (np.min, np.max))
        return np.array(low), np.array(high)


def _find_unhidden(pixels: F64, depth: F64) -> Bools:
    """Return which points (N,) are not clearly behind another one of nearly the same pixel."""
    if not len(pixels):
        return np.zeros(0, dtype=bool)
    cells = np.floor((pixels + 0.5) / HIDING_CELL_PX).astype(np.int64)
    group = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    nearest = np.full(group.max() + 1, np.inf)
    np.minimum.at(nearest, group, depth)
    return np.asarray(depth < nearest[group] + HIDING_DEPTH_M)
