# SPDX-License-Identifier: Apache-2.0
"""A person as several calibrated cameras show them, and which of these agree with what depth sensors saw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64, U8, Bools
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.rim_term import Outline, measure_outside

OUTSIDE_M, MAX_OUTSIDE_SHARE = 0.06, 0.25
"""Distance from a silhouette at which a point of the person lies outside, and the share of such points from which on
the camera shows another person, another moment or another place."""
MIN_JUDGING_POINTS = 100
"""Points in an image that tell whether its silhouette belongs to them."""
MAX_JUDGING_POINTS = 3000


@dataclass(frozen=True, slots=True, eq=False)
class SilhouettePerson:
    """What several cameras show of one person at one time.

    Attributes:
        id: the person's.
        views: camera name -> the camera at the mask's size, and the mask (h, w), positive on the person.
        joints: name -> (x, y, z in metres, confidence 0 to 1), triangulated, in the cameras' world.
    """

    id: str
    views: Mapping[str, tuple[Camera, U8]]
    joints: Mapping[str, tuple[float, float, float, float]]

    def move(self, rotation: F64, translation: F64) -> SilhouettePerson:
        """Return the same in a world to which `rotation` (3, 3) and then `translation` (3,) m lead."""
        placed = {name: rotation @ np.array(joint[:3]) + translation for name, joint in self.joints.items()}
        return SilhouettePerson(
            self.id,
            {name: (camera.move(rotation, translation), mask) for name, (camera, mask) in self.views.items()},
            {name: (float(p[0]), float(p[1]), float(p[2]), self.joints[name][3]) for name, p in placed.items()},
        )

    def find_unusable(self, points: F64, others: Sequence[SilhouettePerson]) -> tuple[list[str], list[str]]:
        """Return the cameras that do not show much of the person's own `points` (N, 3) m where they should.

        Those in which `others` hide the person, and those that show another person, moment or place.
        """
        hidden, contradicted = list[str](), list[str]()
        few = points[:: 1 + len(points) // MAX_JUDGING_POINTS]
        for name, (camera, mask) in self.views.items():
            if not 0 < np.count_nonzero(mask) < mask.size:
                continue
            seen, distance, _ = measure_outside(few, Outline.of(camera, mask))
            outside = few[seen[distance > OUTSIDE_M]]
            if len(seen) < MIN_JUDGING_POINTS or len(outside) <= MAX_OUTSIDE_SHARE * len(seen):
                continue
            in_front = [other.views[name] for other in others if name in other.views]
            free = len(outside) - np.count_nonzero(_find_covered(outside, in_front))
            (contradicted if free > MAX_OUTSIDE_SHARE * len(seen) else hidden).append(name)
        return hidden, contradicted


def _find_covered(points: F64, views: Sequence[tuple[Camera, U8]]) -> Bools:
    """Return which of the points (N, 3) m project into any of the masks (h, w)."""
    covered = np.zeros(len(points), dtype=bool)
    for camera, mask in views:
        pixels, _ = camera.project(points)
        column, row = np.rint(np.nan_to_num(pixels, nan=-1e6)).astype(np.int64).T
        inside = (column >= 0) & (row >= 0) & (column < mask.shape[1]) & (row < mask.shape[0])
        covered[inside] |= mask[row[inside], column[inside]] > 0
    return covered
