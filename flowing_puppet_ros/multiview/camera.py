# SPDX-License-Identifier: Apache-2.0
"""Calibrated pinhole cameras with the plumb_bob lens model of sensor_msgs/CameraInfo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.errors import InputError

_LENS_MODELS = ("plumb_bob", "")
_RADIUS2 = np.linspace(0.0, 5.0, 5001) ** 2  # squared radii on the image plane at which the lens model is checked
_NEWTON_STEPS = 20  # to invert the lens model
_NEWTON_ACCURACY = 1e-10  # on the image plane at depth 1


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A camera: X_camera = rotation @ X_world + translation, z forward, x right, y down, metres.

    Attributes:
        matrix: (3, 3) K in pixels, (0, 0) being the centre of the top-left pixel.
        distortion: (5,) k1 k2 p1 p2 k3 of Brown's lens model.
        size: (width, height) in pixels.
        rotation: (3, 3).
        translation: (3,) metres.
    """

    matrix: F64
    distortion: F64
    size: tuple[int, int]
    rotation: F64
    translation: F64

    @classmethod
    def from_info(
        cls,
        k: ArrayLike,
        d: ArrayLike,
        width: int,
        height: int,
        rotation: ArrayLike,
        translation: ArrayLike,
        lens_model: str = "plumb_bob",
    ) -> Camera:
        """Make a camera from the fields k (9,) or (3, 3), d, width, height of a CameraInfo and its extrinsics.

        Raises InputError for an uncalibrated camera (all-zero K), for a lens model other than plumb_bob, for values
        that are not finite and for a `rotation` that is not one.
        """
        if lens_model not in _LENS_MODELS:
            raise InputError(f"the camera's distortion_model is {lens_model!r}; rectify the images or use plumb_bob")
        matrix = _check_array(k, "camera matrix k", (9,)).reshape(3, 3)
        if not matrix.any():
            raise InputError("the camera_info is uncalibrated (k is all zero); publish a calibrated camera_info")
        if matrix[0, 0] <= 0 or matrix[1, 1] <= 0 or not np.array_equal(matrix[2], (0, 0, 1)):
            raise InputError(f"the camera matrix k is {matrix.ravel().tolist()}, which is not that of a pinhole camera")
        if width <= 0 or height <= 0:
            raise InputError(f"the camera_info says {width} x {height} pixels; both must be positive")
        coefficients = np.asarray(d, np.float64).ravel()
        if coefficients.size > 5 or not np.isfinite(coefficients).all():
            raise InputError(f"the distortion d is {coefficients.tolist()}; plumb_bob has up to 5 finite coefficients")
        world_to_camera = _check_array(rotation, "camera rotation", (9,)).reshape(3, 3)
        if (
            not np.allclose(world_to_camera @ world_to_camera.T, np.eye(3), atol=1e-5)
            or np.linalg.det(world_to_camera) < 0
        ):
            raise InputError(
                f"the camera rotation is {world_to_camera.ravel().tolist()}, which is not a rotation matrix"
            )
        distortion = np.zeros(5)
        distortion[: coefficients.size] = coefficients
        return cls(
            matrix,
            distortion,
            (int(width), int(height)),
            world_to_camera,
            _check_array(translation, "camera translation", (3,)),
        )

    @property
    def centre(self) -> F64:
        """Centre of projection (3,) in the world, metres."""
        return -self.rotation.T @ self.translation

    @property
    def focal(self) -> float:
        """Mean focal length in pixels: pixels per metre at one metre depth."""
        return float(np.sqrt(self.matrix[0, 0] * self.matrix[1, 1]))

    @property
    def max_squared_radius(self) -> float:
        """Squared distance from the axis on the image plane at depth 1 up to which the radial lens model is one-to-one.

        Beyond it the model would fold points far outside the view back into the image. Infinite when there is no fold
        within 79 degrees of the axis.
        """
        k1, k2, _, _, k3 = self.distortion
        slope = 1 + _RADIUS2 * (3 * k1 + _RADIUS2 * (5 * k2 + _RADIUS2 * 7 * k3))
        folded = np.flatnonzero(slope <= 0)
        return float(_RADIUS2[folded[0] - 1]) if len(folded) else np.inf

    def equals(self, other: Camera) -> bool:
        """Return whether both cameras project every point to the same pixel."""
        names = ("matrix", "distortion", "size", "rotation", "translation")
        return all(np.array_equal(getattr(self, name), getattr(other, name)) for name in names)

    def to_camera(self, points: ArrayLike) -> F64:
        """Return world points (..., 3) in this camera's frame, metres."""
        return np.asarray(points, np.float64) @ self.rotation.T + self.translation

    def project(self, points: ArrayLike) -> tuple[F64, F64]:
        """Return pixels (..., 2) and depths (...) in metres of world points (..., 3).

        Pixels are NaN for points behind the camera or beyond `max_squared_radius`.
        """
        local = self.to_camera(points)
        depth = local[..., 2]
        plane = local[..., :2] / np.where(depth > 0, depth, np.nan)[..., None]
        if not self.distortion.any():
            return self.to_pixels(plane), depth
        radius2 = plane[..., :1] ** 2 + plane[..., 1:] ** 2
        plane = np.where(radius2 <= self.max_squared_radius, plane, np.nan)
        return self.to_pixels(distort(plane, self.distortion)), depth

    def to_pixels(self, image_plane: F64) -> F64:
        """Return the pixels (..., 2) of (distorted) points (..., 2) on the image plane at depth 1."""
        return image_plane @ self.matrix[:2, :2].T + self.matrix[:2, 2]

    def undistort(self, pixels: ArrayLike) -> F64:
        """Return points (..., 2) on the undistorted image plane at depth 1; NaN where the lens model has no inverse."""
        offset = np.asarray(pixels, np.float64) - self.matrix[:2, 2]
        return _remove_distortion(offset @ np.linalg.inv(self.matrix[:2, :2]).T, self.distortion)

    def cast_rays(self, pixels: ArrayLike) -> F64:
        """Return the unit directions (..., 3) in the world of the rays through pixels (..., 2)."""
        plane = self.undistort(pixels)
        direction = np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], axis=-1) @ self.rotation
        return direction / np.linalg.norm(direction, axis=-1, keepdims=True)

    def move(self, rotation: F64, translation: F64) -> Camera:
        """Return the camera in a world to which `rotation` (3, 3) and then `translation` (3,) m lead."""
        turn = self.rotation @ rotation.T
        return replace(self, rotation=turn, translation=self.translation - turn @ translation)

    def scale(self, factor: float) -> Camera:
        """Return the camera for the image resized by `factor`: the size in whole pixels, and K to match it exactly."""
        width, height = (max(1, round(side * factor)) for side in self.size)
        return self.resize((width, height))

    def resize(self, size: Sequence[int]) -> Camera:
        """Return the camera for the image resized to `size` (width, height), as by cv2.resize."""
        factor = np.array([size[0] / self.size[0], size[1] / self.size[1]])
        matrix = self.matrix.copy()
        matrix[:2] *= factor[:, None]
        matrix[:2, 2] += 0.5 * factor - 0.5
        return replace(self, matrix=matrix, size=(int(size[0]), int(size[1])))


def distort(plane: F64, coefficients: F64) -> F64:
    """Return where the lens moves points (..., 2) on the image plane at depth 1 (Brown 1966; k1 k2 p1 p2 k3)."""
    k1, k2, p1, p2, k3 = coefficients
    x, y = plane[..., 0], plane[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def _distortion_jacobian(plane: F64, coefficients: F64) -> F64:
    """Return the derivatives (..., 2, 2) of `distort` by the undistorted point."""
    k1, k2, p1, p2, k3 = coefficients
    x, y = plane[..., 0], plane[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
    jacobian = np.empty((*x.shape, 2, 2))
    jacobian[..., 0, 0] = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    jacobian[..., 1, 1] = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    jacobian[..., 0, 1] = jacobian[..., 1, 0] = slope * x * y + 2 * p1 * x + 2 * p2 * y
    return jacobian


def _remove_distortion(distorted: F64, coefficients: F64) -> F64:
    """Invert `distort` by Newton's method, started at the distorted point; NaN where it does not converge."""
    if not coefficients.any():
        return distorted
    plane = distorted.copy()
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            residual = distort(plane, coefficients) - distorted
            jacobian = _distortion_jacobian(plane, coefficients)
            a, b, d = jacobian[..., 0, 0], jacobian[..., 0, 1], jacobian[..., 1, 1]
            u, v = residual[..., 0], residual[..., 1]
            plane = plane - np.stack([d * u - b * v, a * v - b * u], axis=-1) / (a * d - b * b)[..., None]
        residual = distort(plane, coefficients) - distorted
        # Beyond the fold of the lens model roots are mirrored: there the Jacobian's determinant is not positive.
        jacobian = _distortion_jacobian(plane, coefficients)
        valid = (np.abs(residual).max(axis=-1) < _NEWTON_ACCURACY) & (np.linalg.det(jacobian) > 0)
    return np.where(valid[..., None], plane, np.nan)


def _check_array(values: ArrayLike, name: str, shape: tuple[int]) -> F64:
    array = np.asarray(values, np.float64).ravel()
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"the {name} is {array.tolist()}; it needs {shape[0]} finite numbers")
    return array
