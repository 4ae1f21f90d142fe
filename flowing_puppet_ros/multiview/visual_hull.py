# SPDX-License-Identifier: Apache-2.0
"""Visual hulls: the space that no calibrated silhouette rules out (Laurentini 1994), as surface points with normals.

The hull is carved with signed distances, not with a binary test: the value of a voxel is the maximum over the cameras
of how many metres it lies outside their silhouettes. The smoothed field has a gradient, so one Newton step places the
points on the surface far more accurately than the size of a voxel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike
from scipy import ndimage

from flowing_puppet_ros.arrays import F32, F64, U8, Bools
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.distance_transform import signed_distance
from flowing_puppet_ros.settings import Settings, setting

MIN_VIEWS = 2  # cameras with a usable silhouette
_MAX_VOXELS = 40_000_000  # of the searched box, about 200 MB
_BAND_VOXELS = 4.0  # on both sides of the surface, beyond which the field is clipped
_MAX_JOINT_DISTANCE_M = 1.6  # of a joint from the middle of its body
_PADDING_VOXELS = 3  # around the carved body, in which the field is smoothed
_MIN_DEPTH_M = 0.01  # of a voxel in front of a camera
_MIN_SLOPE = 0.2  # of the field at surface points; 1 in a true distance field

# Arrays and numbers of a camera for the compiled loop: matrix, distortion, maximum squared radius, rotation,
# translation, focal length.
CameraArrays = tuple[F64, F64, float, F64, F64, float]


@dataclass(frozen=True)
class HullSettings(Settings):
    """How the visual hull is carved."""

    voxel: float = setting(0.02, "edge of a voxel", unit="m", low=0.002, high=0.5)
    tolerance: float = setting(
        0.005, "distance outside a silhouette up to which a voxel is kept", unit="m", low=-0.1, high=0.2
    )
    smoothing: float = setting(
        0.7,
        "standard deviation of the smoothing of the distance field",
        unit="voxels",
        low=0.3,
        high=3.0,
        advanced=True,
    )
    margin: float = setting(
        0.3, "margin around the joints within which the body is carved", unit="m", low=0.05, high=2.0
    )


def visual_hull(
    cameras: Sequence[Camera],
    masks: Sequence[U8],
    bounds: ArrayLike,
    settings: HullSettings | None = None,
) -> tuple[F64, F64]:
    """Carve the hull of silhouettes and return the surface of its largest component.

    A camera rules out nothing outside its image, and voxels that fewer than two cameras see are dropped.

    Args:
        cameras: one camera for each mask; it is resized to the mask.
        masks: uint8 (h, w) of any size, positive on the body.
        bounds: (2, 3) low and high corner of the searched box in the world, metres.
        settings: how to carve.

    Returns:
        Points (N, 3) in metres and outward unit normals (N, 3).

    Raises:
        InputError: when masks do not match the cameras or the box cannot be searched.
        PuppetError: when fewer than two cameras have a mask, or the masks leave nothing.
    """
    settings = settings or HullSettings()
    corners = _check_bounds(bounds, settings.voxel)
    views = [
        _SignedSilhouette.of(camera, mask)
        for camera, mask in zip(cameras, _check_masks(cameras, masks), strict=True)
        if mask.any()
    ]
    if len(views) < MIN_VIEWS:
        raise PuppetError(f"a visual hull needs the silhouettes of at least {MIN_VIEWS} cameras, got {len(views)}")
    field = _make_distance_field(views, corners, settings)
    body = _find_largest_component(field <= settings.tolerance)
    if body is None:
        raise PuppetError(f"the silhouettes of {len(views)} cameras have no common space in {_describe(corners)}")
    return _extract_surface(field, body, corners[0], settings)


def bounds_of_joints(joints: ArrayLike, margin: float) -> F64 | None:
    """Return the box (2, 3) around `joints` (J, 3) m with `margin` metres; None when one is NaN or too far off."""
    points = np.asarray(joints, np.float64)
    if len(points) == 0 or not np.isfinite(points).all():
        return None
    if np.linalg.norm(points - np.median(points, axis=0), axis=1).max() > _MAX_JOINT_DISTANCE_M:
        return None
    return np.stack([points.min(axis=0) - margin, points.max(axis=0) + margin])


def bounds_of_masks(cameras: Sequence[Camera], masks: Sequence[U8], margin: float) -> F64:
    """Return a cube (2, 3) in metres that contains the body when no joint is known.

    It is centred where the rays through the masks' middles are closest, and spans the largest mask at that depth.
    Raises PuppetError with fewer than two masks, or when the rays do not meet in front of the cameras.
    """
    views = [(camera.resize(mask.shape[::-1]), np.argwhere(mask)) for camera, mask in zip(cameras, masks, strict=True)]
    views = [(camera, filled) for camera, filled in views if len(filled)]
    if len(views) < MIN_VIEWS:
        raise PuppetError(f"a visual hull needs the silhouettes of at least {MIN_VIEWS} cameras, got {len(views)}")
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for camera, filled in views:
        direction = camera.cast_rays(0.5 * (filled.min(axis=0) + filled.max(axis=0))[::-1])
        across = np.eye(3) - np.outer(direction, direction)
        normal += across
        right += across @ camera.centre
    middle = np.linalg.lstsq(normal, right, rcond=None)[0]
    depths = np.array([camera.to_camera(middle)[2] for camera, _ in views])
    if (depths <= 0).any():
        raise PuppetError(
            "the silhouettes' rays do not meet in front of the cameras; check the extrinsics on /tf_static"
        )
    spans = [np.ptp(filled, axis=0).max() / camera.focal for camera, filled in views]
    half = 0.5 * float((np.array(spans) * depths).max()) + margin
    return np.stack([middle - half, middle + half])


@dataclass(frozen=True, slots=True, eq=False)
class _SignedSilhouette:
    """A camera at its mask's size and the mask's signed `distance` (h, w) in pixels, positive outside."""

    camera: Camera
    distance: F32

    @classmethod
    def of(cls, camera: Camera, mask: U8) -> _SignedSilhouette:
        return cls(camera.resize(mask.shape[::-1]), signed_distance(mask).astype(np.float32))


def _make_distance_field(views: list[_SignedSilhouette], corners: F64, settings: HullSettings) -> F32:
    """Return the maximum signed distance (X, Y, Z) over the cameras in metres, clipped; the clip value where unseen."""
    shape = np.maximum(np.ceil((corners[1] - corners[0]) / settings.voxel).astype(int) + 1, 2)
    band = _BAND_VOXELS * settings.voxel + abs(settings.tolerance)
    field = np.full(shape, -band, np.float32)
    seen = np.zeros(shape, np.uint8)
    for view in views:
        camera = view.camera
        arrays: CameraArrays = (
            camera.matrix, camera.distortion, camera.max_squared_radius, camera.rotation, camera.translation,
            camera.focal,
        )  # fmt: skip
        distance = np.ascontiguousarray(view.distance)
        _carve((field, seen), (corners[0], settings.voxel, np.float32(band)), distance, arrays)
    field[seen < MIN_VIEWS] = band
    return field


@njit(cache=True, nogil=True, error_model="numpy")
def _carve(volume, grid, distance, camera):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Raise a field (X, Y, Z) to one camera's signed distances in metres; count the cameras that see each voxel.

    `volume` is the field and the count, `grid` the first voxel's centre, the edge of a voxel and the clip value.
    """
    (field, seen), (origin, voxel, band) = volume, grid
    matrix, lens, max_squared_radius, rotation, translation, focal = camera
    height, width = distance.shape
    step = voxel * rotation[:, 2]
    for i in range(field.shape[0]):
        for j in range(field.shape[1]):
            start = rotation[:, 0] * (origin[0] + i * voxel) + rotation[:, 1] * (origin[1] + j * voxel)
            start += rotation[:, 2] * origin[2] + translation
            for k in range(field.shape[2]):
                if field[i, j, k] >= band:
                    continue
                depth = start[2] + k * step[2]
                if depth <= _MIN_DEPTH_M:
                    continue
                x, y = (start[0] + k * step[0]) / depth, (start[1] + k * step[1]) / depth
                r2 = x * x + y * y
                if r2 > max_squared_radius:
                    continue
                radial = 1 + r2 * (lens[0] + r2 * (lens[1] + r2 * lens[4]))
                u = x * radial + 2 * lens[2] * x * y + lens[3] * (r2 + 2 * x * x)
                v = y * radial + lens[2] * (r2 + 2 * y * y) + 2 * lens[3] * x * y
                column = matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2]
                row = matrix[1, 1] * v + matrix[1, 2]
                if not (0 <= column <= width - 1 and 0 <= row <= height - 1):
                    continue
                c, r = min(int(column), width - 2), min(int(row), height - 2)
                fc, fr = column - c, row - r
                top = distance[r, c] * (1 - fc) + distance[r, c + 1] * fc
                bottom = distance[r + 1, c] * (1 - fc) + distance[r + 1, c + 1] * fc
                value = (top * (1 - fr) + bottom * fr) * depth / focal
                field[i, j, k] = min(max(field[i, j, k], value), band)
                seen[i, j, k] += 1


def _find_largest_component(body: Bools) -> Bools | None:
    labels, count = ndimage.label(body)
    if count == 0:
        return None
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels == int(sizes.argmax())


def _extract_surface(field: F32, body: Bools, origin: F64, settings: HullSettings) -> tuple[F64, F64]:
    """Return points on the smoothed field's level set near the body's outer voxels, and its unit gradients there."""
    box = ndimage.find_objects(body.astype(np.uint8))[0]
    low = np.array([max(0, side.start - _PADDING_VOXELS) for side in box])
    window = tuple(slice(a, side.stop + _PADDING_VOXELS) for a, side in zip(low, box, strict=True))
    smooth = ndimage.gaussian_filter(field[window], settings.smoothing, mode="nearest")
    kept = body[window]
    # The faces of the box are not surface: border_value keeps them out.
    outer = np.argwhere(kept & ~ndimage.binary_erosion(kept, border_value=1))
    value = smooth[tuple(outer.T)].astype(np.float64) - settings.tolerance
    gradient = np.stack([part[tuple(outer.T)] for part in np.gradient(smooth)], axis=1).astype(np.float64)
    slope = np.linalg.norm(gradient, axis=1)
    # Where two sheets meet, the field is flat and has no direction.
    steep = slope > _MIN_SLOPE * settings.voxel
    normals = gradient[steep] / slope[steep, None]
    step = np.clip(value[steep] / slope[steep], -1.0, 1.0)
    points = origin + settings.voxel * (low + outer[steep] - step[:, None] * normals)
    return points, normals


def _check_masks(cameras: Sequence[Camera], masks: Sequence[U8]) -> Sequence[U8]:
    if len(cameras) != len(masks):
        raise InputError(f"a visual hull needs one mask per camera, got {len(masks)} for {len(cameras)} cameras")
    for index, (camera, mask) in enumerate(zip(cameras, masks, strict=True)):
        if mask.ndim != 2 or mask.dtype != np.uint8 or min(mask.shape) < 2:
            raise InputError(f"mask {index} is {mask.shape} of {mask.dtype}; it needs (h, w) of uint8")
        width, height = camera.size
        # Rounding to whole pixels changes a resized image's aspect by up to one pixel.
        if abs(mask.shape[1] * height - mask.shape[0] * width) > max(width, height):
            raise InputError(
                f"mask {index} is {mask.shape[1]} x {mask.shape[0]}, which is not a scaled {width} x {height} image"
            )
    return masks


def _check_bounds(bounds: ArrayLike, voxel: float) -> F64:
    corners = np.asarray(bounds, np.float64)
    if corners.shape != (2, 3) or not np.isfinite(corners).all() or not (corners[0] < corners[1]).all():
        raise InputError(f"the bounds are {corners.tolist()}; give a finite low and high corner")
    if np.prod(np.ceil((corners[1] - corners[0]) / voxel) + 1) > _MAX_VOXELS:
        raise InputError(f"{_describe(corners)} has too many voxels of {voxel:g} m; use larger voxels or a smaller box")
    return corners


def _describe(corners: F64) -> str:
    size = corners[1] - corners[0]
    return f"the box of {size[0]:.2f} x {size[1]:.2f} x {size[2]:.2f} m"
