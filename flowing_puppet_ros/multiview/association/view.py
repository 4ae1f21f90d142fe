# SPDX-License-Identifier: Apache-2.0
"""A person in the image of one camera, and how well it agrees with joints in space or with another camera's person."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.multiview.camera import Camera

MIN_COMMON_JOINTS = 4
"""Minimum joints that two observations of a person must share to be compared."""
_MAX_JOINT_FROM_MIDDLE_M = 1.3
_MIN_SINE = np.sin(np.radians(4.0))  # of the angle between two rays that place a joint
_NO_MATCH = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class PersonInView:
    """A person in one image.

    Attributes:
        id: of the camera's own tracker.
        joints: (J, 2) px, NaN where unknown.
        confidence: (J,) in [0, 1].
        colours: histogram of the torso, see `image.tracking.appearance`; None where it is unknown.
    """

    id: str
    joints: F64
    confidence: F64
    colours: F64 | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedView:
    """A person in one image with its rays.

    Attributes:
        person: what the camera's tracker says.
        camera: calibration of the image.
        plane: (J, 2) joints on the undistorted image plane at depth 1, NaN where unknown.
        weight: (J,) confidence, 0 where unknown.
        rays: (J, 3) unit directions in the world, NaN where unknown.
    """

    person: PersonInView
    camera: Camera
    plane: F64
    weight: F64
    rays: F64 = field(repr=False)

    @classmethod
    def of(cls, person: PersonInView, camera: Camera, min_confidence: float) -> CalibratedView:
        """Cast the rays of a person's joints of at least `min_confidence`."""
        plane = camera.undistort(person.joints)
        known = np.isfinite(plane).all(axis=1) & (person.confidence >= min_confidence) & (person.confidence > 0)
        plane = np.where(known[:, None], plane, np.nan)
        rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=1) @ camera.rotation
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        return cls(person, camera, plane, np.where(known, np.clip(person.confidence, 0.0, 1.0), 0.0), rays)

    def measure_distances(self, joints: F64) -> F64:
        """Return the distances (J,) m of joints (J, 3) from their rays, at the joints' depth; NaN where unknown."""
        local = self.camera.to_camera(joints)
        depth = np.where(local[:, 2] > 0, local[:, 2], np.nan)
        return np.linalg.norm(local[:, :2] - self.plane * depth[:, None], axis=1)


def measure_mismatch(view: CalibratedView, joints: F64, max_distance: float) -> float:
    """Return how badly a view fits joints (J, 3) m: 0 exactly, 1 not at all or when too few joints are in both.

    The weighted mean of the joints' distances from their rays, in shares of `max_distance` (m) and at most 1 each.
    """
    return _mean_share(view.measure_distances(joints), view.weight, max_distance)


def measure_ray_mismatch(one: CalibratedView, other: CalibratedView, max_distance: float) -> float:
    """Return how badly two views fit one person: 0 to 1 as in `measure_mismatch`.

    By the epipolar distance of all joints: the shortest distance of their rays. What the rays have in common must also
    lie before both cameras and be no larger than a person.
    """
    base = other.camera.centre - one.camera.centre
    normal = np.cross(one.rays, other.rays)
    sine = np.linalg.norm(normal, axis=1)
    usable = sine > _MIN_SINE
    safe = np.where(usable, sine, np.nan)
    distance = np.abs(normal @ base) / safe
    along_one = np.einsum("jk,jk->j", np.cross(base, other.rays), normal) / safe**2
    along_other = np.einsum("jk,jk->j", np.cross(base, one.rays), normal) / safe**2
    ahead = (along_one > 0) & (along_other > 0)
    points = np.where(ahead[:, None], one.camera.centre + along_one[:, None] * one.rays, np.nan)
    if np.count_nonzero(ahead) < MIN_COMMON_JOINTS:
        return _NO_MATCH
    far = np.linalg.norm(points - np.nanmedian(points, axis=0), axis=1) > _MAX_JOINT_FROM_MIDDLE_M
    distance = np.where(far | (usable & ~ahead), np.inf, distance)
    return _mean_share(distance, np.sqrt(one.weight * other.weight), max_distance)


def _mean_share(distance: F64, weight: F64, max_distance: float) -> float:
    known = ~np.isnan(distance) & (weight > 0)
    if np.count_nonzero(known) < MIN_COMMON_JOINTS:
        return _NO_MATCH
    shares = np.minimum(distance[known] / max_distance, 1.0)
    return float((weight[known] * shares).sum() / weight[known].sum())


def calibrate_views(
    cameras: Mapping[str, Camera], people: Mapping[str, Sequence[PersonInView]], min_confidence: float
) -> dict[str, list[CalibratedView]]:
    """Return the views of everybody in each calibrated camera."""
    return {
        name: [CalibratedView.of(person, cameras[name], min_confidence) for person in group]
        for name, group in people.items()
        if name in cameras
    }
