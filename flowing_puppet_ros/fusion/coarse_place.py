# SPDX-License-Identifier: Apache-2.0
"""Where people roughly are whom a camera sees and the depth does not: as far away as their size in the image says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.fusion.puppet_joints import MIN_PUPPET_JOINTS, PuppetJoints, measure_distance_by_size
from flowing_puppet_ros.fusion.seen_cloud import SeenCloud
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.multiview.camera import Camera

MIN_CONFIDENCE = 0.3
RADIUS_M, MAX_SEEN_SHARE = 0.06, 0.3
"""Around a joint, within which a point of the cloud says that there is depth, and the share of joints with depth from
which on it is the cloud's to say whether somebody is there."""
COARSE_CONFIDENCE = 0.3
"""Of a joint that the camera is sure of: the place across the ray is known, along it only roughly."""


@dataclass(frozen=True, slots=True, eq=False)
class CoarsePerson:
    """A person with joints (J, 3) m in the body model's order, NaN where unknown, and their confidence (J,)."""

    id: str
    joints: F64
    confidence: F64

    def move(self, rotation: F64, translation: F64) -> CoarsePerson:
        """Return the person in a frame to which `rotation` (3, 3) and then `translation` (3,) m lead."""
        return CoarsePerson(self.id, self.joints @ rotation.T + translation, self.confidence)


def _place_coarsely(
    model: StitchedPuppet, puppet: PuppetJoints, camera: Camera, seen: cKDTree | None
) -> CoarsePerson | None:
    """Return the person of a puppet where no depth is known; None where it is, or where the puppet tells no size.

    `seen` are the pixels of the points, None without any.
    """
    sure = puppet.known & (puppet.confidence >= MIN_CONFIDENCE)
    if np.count_nonzero(sure) < MIN_PUPPET_JOINTS:
        return None
    rays = camera.cast_rays(puppet.pixels)
    distance = measure_distance_by_size(model, rays, sure)
    if np.isnan(distance):
        return None
    if seen is not None:
        radius = RADIUS_M * camera.focal / distance
        near, _ = seen.query(puppet.pixels[sure], distance_upper_bound=max(radius, 1.0))
        if np.isfinite(near).mean() > MAX_SEEN_SHARE:
            return None
    joints = np.where(puppet.known[:, None], camera.centre + rays * distance, np.nan)
    return CoarsePerson(puppet.id, joints, np.where(puppet.known, COARSE_CONFIDENCE * puppet.confidence, 0.0))


def place_others(model: StitchedPuppet, puppets: Sequence[PuppetJoints], cloud: SeenCloud) -> list[CoarsePerson]:
    """Return the people of the puppets with an id of whom there is no depth."""
    named = [puppet for puppet in puppets if puppet.id]
    if not named:
        return []
    pixels = cloud.pixels[cloud.seen]
    seen = cKDTree(pixels) if len(pixels) else None
    found = [_place_coarsely(model, puppet, cloud.camera, seen) for puppet in named]
    return [person for person in found if person is not None]
