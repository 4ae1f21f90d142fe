# SPDX-License-Identifier: Apache-2.0
"""Several calibrated cameras by name, with what the files of calibration programs know about them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.camera import Camera

_MAX_ROTATION_ERROR = 1e-3  # of R @ R.T from the identity; files are rounded
_ROUNDING = 1e-12  # of R @ R.T from the identity that is left as it is


@dataclass(frozen=True, slots=True, eq=False)
class RigCamera:
    """One camera of a rig.

    Attributes:
        camera: calibration; `camera.size` is a guess from the principal point where `has_size` is false.
        has_size: whether the file says how large the images are.
        time_offset: seconds to add to the stamps of the camera's images.
    """

    camera: Camera
    has_size: bool = True
    time_offset: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class CameraRig:
    """Cameras by name in one world frame; `unit` is that of the lengths, "" where the file does not tell."""

    cameras: Mapping[str, RigCamera]
    unit: str = ""

    def rescale(self, factor: float) -> CameraRig:
        """Return the rig with all lengths multiplied by `factor`, in metres."""
        moved = {
            name: replace(each, camera=replace(each.camera, translation=each.camera.translation * factor))
            for name, each in self.cameras.items()
        }
        return CameraRig(moved, "m")

    def rotate_world(self, rotation: F64) -> CameraRig:
        """Return the rig in the world of X' = rotation @ X, with `rotation` (3, 3)."""
        turned = {
            name: replace(each, camera=replace(each.camera, rotation=each.camera.rotation @ rotation.T))
            for name, each in self.cameras.items()
        }
        return CameraRig(turned, self.unit)


def make_rig_camera(
    name: str,
    matrix: ArrayLike,
    distortion: ArrayLike,
    size: tuple[float, float] | None,
    rotation: ArrayLike,
    translation: ArrayLike,
    time_offset: float = 0.0,
) -> RigCamera:
    """Make a camera from K (3, 3), up to 5 coefficients k1 k2 p1 p2 k3, (width, height) px and world-to-camera R, t.

    `rotation` is a matrix (3, 3) or a rotation vector (3,). InputError, which names the camera, for what is no pinhole
    camera and for a mirrored or distorted rotation.
    """
    try:
        k = np.asarray(matrix, np.float64).reshape(3, 3)
        coefficients = np.asarray(distortion, np.float64).ravel()
        turned = np.asarray(rotation, np.float64)
        turned = cv2.Rodrigues(turned.reshape(3, 1))[0] if turned.size == 3 else turned.reshape(3, 3)
        moved = np.asarray(translation, np.float64).reshape(3)
    except (ValueError, TypeError) as error:
        raise InputError(f"the calibration of {name} has an entry of the wrong size: {error}") from error
    if not (np.isfinite(turned).all() and np.abs(turned @ turned.T - np.eye(3)).max() < _MAX_ROTATION_ERROR):
        raise InputError(f"the rotation of {name} is {np.round(turned, 4).tolist()}, which is not a rotation matrix")
    if np.linalg.det(turned) < 0:
        raise InputError(f"the rotation of {name} is mirrored (its determinant is -1): one axis has the wrong sign")
    if np.abs(turned @ turned.T - np.eye(3)).max() > _ROUNDING:
        u, _, v = np.linalg.svd(turned)
        turned = u @ v
    while len(coefficients) > 5 and coefficients[-1] == 0:
        coefficients = coefficients[:-1]
    width, height = size or (2 * k[0, 2] + 1, 2 * k[1, 2] + 1)
    try:
        camera = Camera.from_info(k, coefficients, max(1, round(width)), max(1, round(height)), turned, moved)
    except InputError as error:
        raise InputError(f"the calibration of {name}: {error}") from error
    return RigCamera(camera, size is not None, float(time_offset))


def check_rig(rig: CameraRig, place: object) -> CameraRig:
    """Return a rig that has two or more cameras at different places; InputError, which begins with `place`, if not."""
    if len(rig.cameras) < 2:
        raise InputError(f"{place} has {len(rig.cameras)} calibrated cameras, and two or more are needed")
    centres = np.array([each.camera.centre for each in rig.cameras.values()])
    if np.ptp(centres, axis=0).max() == 0:
        raise InputError(f"{place} puts all cameras at one place: it has intrinsics only, without extrinsics")
    return rig
