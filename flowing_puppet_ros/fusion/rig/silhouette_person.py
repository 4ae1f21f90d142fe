# SPDX-License-Identifier: Apache-2.0
"""A person as several calibrated cameras show them, and which of these agree with what depth sensors saw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.arrays import F64, U8
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

        def put(camera: Camera) -> Camera:
            turn = camera.rotation @ rotation.T
            return replace(camera, rotation=turn, translation=camera.translation - turn @ translation)

        placed = {name: rotation @ np.array(joint[:3]) + translation for name, joint in self.joints.items()}
        return SilhouettePerson(
            self.id,
            {name: (put(camera), mask) for name, (camera, mask) in self.views.items()},
            {name: (float(p[0]), float(p[1]), float(p[2]), self.joints[name][3]) for name, p in placed.items()},
        )

    def find_contradicted(self, points: F64) -> list[str]:
        """Return the cameras in whose silhouettes much of the person's own `points` (N, 3) m does not lie."""
        few = points[:: 1 + len(points) // MAX_JUDGING_POINTS]
        return [name for name, view in self.views.items() if _is_contradicted(*view, few)]


def _is_contradicted(camera: Camera, mask: U8, points: F64) -> bool:
    if not 0 < np.count_nonzero(mask) < mask.size:
        return False
    seen, distance, _ = measure_outside(points, Outline.of(camera, mask))
    return len(seen) >= MIN_JUDGING_POINTS and bool((distance > OUTSIDE_M).mean() > MAX_OUTSIDE_SHARE)
