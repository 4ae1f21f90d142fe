# SPDX-License-Identifier: Apache-2.0
"""Visual hulls: the space that no calibrated silhouette rules out (Laurentini 1994), as surface points with normals.

The hull is carved with signed distances instead of yes and no: at every voxel each camera tells how many metres the
voxel lies outside its silhouette, and the largest value counts. The smoothed field has a gradient, so that one Newton
step puts the points on the surface far more finely than the voxels are.
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

MIN_VIEWS = 2
_MAX_VOXELS = 40_000_000
_BAND = 4.0  # voxels to either side of the surface in which the field is kept
_BODY_REACH = 1.6  # metres from the middle of a body that no joint exceeds
_PADDING = 3  # voxels around the carved body in which the field is smoothed


@dataclass(frozen=True)
class HullSettings(Settings):
    """How the visual hull is carved."""

    voxel: float = setting(0.02, "edge of a voxel", unit="m", low=0.002, high=0.5)
    tolerance: float = setting(
        0.005, "how far outside a silhouette a voxel may lie and still be kept", unit="m", low=-0.1, high=0.2
    )
    smoothing: float = setting(0.7, "spread of the smoothing of the distance field", unit="voxels", low=0.3, high=3.0)
    margin: float = setting(0.3, "space around the joints that is searched for the body", unit="m", low=0.05, high=2.0)


def visual_hull(
    cameras: Sequence[Camera],
    masks: Sequence[U8],
    bounds: ArrayLike,
    settings: HullSettings | None = None,
) -> tuple[F64, F64]:
    """Carve the hull of `masks` within `bounds` and return its largest component's surface.

    `masks` are uint8 (h,w), positive on the body, of any size: each camera is resized to its mask. `bounds` (2,3) are
    the low and high corner of the searched box in the world, metres. A camera accepts what falls outside its image;
    a place that fewer than two cameras see is not kept. Returns points (N,3) and outward unit normals (N,3).
    Raises InputError for masks that fit no camera or box, PuppetError when fewer than two cameras have a usable mask
    or the masks leave nothing.
    """
    settings = settings or HullSettings()
    corners = _checked_bounds(bounds, settings.voxel)
    views = [
        _SignedSilhouette.of(camera, mask)
        for camera, mask in zip(cameras, _checked_masks(cameras, masks), strict=True)
        if mask.any()
    ]
    if len(views) < MIN_VIEWS:
        raise PuppetError(f"a visual hull needs the silhouettes of at least {MIN_VIEWS} cameras, got {len(views)}")
    field = _distance_field(views, corners, settings)
    body = _largest_component(field <= settings.tolerance)
    if body is None:
        raise PuppetError(f"the silhouettes of {len(views)} cameras have no common space in {_text(corners)}")
    return _surface(field, body, corners[0], settings)


def bounds_of_joints(joints: ArrayLike, margin: float) -> F64 | None:
    """The box (2,3) with `margin` metres about `joints` (J,3); None when one is NaN or they are no one body's."""
    points = np.asarray(joints, np.float64)
    if len(points) == 0 or not np.isfinite(points).all():
        return None
    if np.linalg.norm(points - np.median(points, axis=0), axis=1).max() > _BODY_REACH:
        return None
    return np.stack([points.min(axis=0) - margin, points.max(axis=0) + margin])


def bounds_of_masks(cameras: Sequence[Camera], masks: Sequence[U8], margin: float) -> F64:
    """A cube (2,3) that holds the body when no joint is known.

    It is centred where the rays through the masks' middles pass closest, and spans the largest mask at that depth.
    Raises PuppetError with fewer than two masks, or rays that do not meet in front of the cameras.
    """
    views = [(camera.resized(mask.shape[::-1]), np.argwhere(mask)) for camera, mask in zip(cameras, masks, strict=True)]
    views = [(camera, filled) for camera, filled in views if len(filled)]
    if len(views) < MIN_VIEWS:
        raise PuppetError(f"a visual hull needs the silhouettes of at least {MIN_VIEWS} cameras, got {len(views)}")
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for camera, filled in views:
        direction = camera.rays(0.5 * (filled.min(axis=0) + filled.max(axis=0))[::-1])
        across = np.eye(3) - np.outer(direction, direction)
        normal += across
        right += across @ camera.centre
    middle = np.linalg.lstsq(normal, right)[0]
    depths = np.array([camera.to_camera(middle)[2] for camera, _ in views])
    if (depths <= 0).any():
        raise PuppetError(
            "the silhouettes' rays do not meet in front of the cameras; check the extrinsics on /tf_static"
        )
    spans = [np.ptp(filled, axis=0).max() / camera.focal for camera, filled in views]
    reach = 0.5 * float((np.array(spans) * depths).max()) + margin
    return np.stack([middle - reach, middle + reach])


@dataclass(frozen=True, slots=True, eq=False)
class _SignedSilhouette:
    """A camera at its mask's size and the mask's signed distance (h,w) in pixels, positive outside."""

    camera: Camera
    distance: F32

    @classmethod
    def of(cls, camera: Camera, mask: U8) -> _SignedSilhouette:
        return cls(camera.resized(mask.shape[::-1]), signed_distance(mask).astype(np.float32))


def _distance_field(views: list[_SignedSilhouette], corners: F64, settings: HullSettings) -> F32:
    """The largest signed distance (X,Y,Z) over the cameras in metres, cut off at a few voxels; large where unseen."""
    shape = np.maximum(np.ceil((corners[1] - corners[0]) / settings.voxel).astype(int) + 1, 2)
    band = _BAND * settings.voxel + abs(settings.tolerance)
    field = np.full(shape, -band, np.float32)
    seen = np.zeros(shape, np.uint8)
    for view in views:
        camera = view.camera
        _carve(
            field, seen, corners[0], settings.voxel, np.float32(band), np.ascontiguousarray(view.distance),
            camera.matrix, camera.distortion, camera.lens_reach, camera.rotation, camera.translation, camera.focal,
        )  # fmt: skip
    field[seen < MIN_VIEWS] = band
    return field


@njit(cache=True, error_model="numpy")
def _carve(field, seen, origin, voxel, band, distance, matrix, lens, reach, rotation, translation, focal):  # type: ignore[no-untyped-def]  # pragma: no cover  # fmt: skip
    """Raise `field` (X,Y,Z) to one camera's signed distances in metres; count the cameras that see each voxel."""
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
                if depth <= 0.01:
                    continue
                x, y = (start[0] + k * step[0]) / depth, (start[1] + k * step[1]) / depth
                r2 = x * x + y * y
                if r2 > reach:
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


def _largest_component(body: Bools) -> Bools | None:
    labels, count = ndimage.label(body)
    if count == 0:
        return None
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels == int(sizes.argmax())


def _surface(field: F32, body: Bools, origin: F64, settings: HullSettings) -> tuple[F64, F64]:
    """Points on the smoothed field's level set near the body's outer voxels, and the field's directions there."""
    box = ndimage.find_objects(body.astype(np.uint8))[0]
    low = np.array([max(0, side.start - _PADDING) for side in box])
    cut = tuple(slice(a, side.stop + _PADDING) for a, side in zip(low, box, strict=True))
    smooth = ndimage.gaussian_filter(field[cut], settings.smoothing, mode="nearest")
    kept = body[cut]
    # The box's own faces are cuts through the searched space, not surface: border_value keeps them out.
    outer = np.argwhere(kept & ~ndimage.binary_erosion(kept, border_value=1))
    value = smooth[tuple(outer.T)].astype(np.float64) - settings.tolerance
    gradient = np.stack([part[tuple(outer.T)] for part in np.gradient(smooth)], axis=1).astype(np.float64)
    slope = np.linalg.norm(gradient, axis=1)
    # A true distance field rises by one voxel a voxel; where two sheets meet it is flat and tells no direction.
    steep = slope > 0.2 * settings.voxel
    normals = gradient[steep] / slope[steep, None]
    step = np.clip(value[steep] / slope[steep], -1.0, 1.0)
    points = origin + settings.voxel * (low + outer[steep] - step[:, None] * normals)
    return points, normals


def _checked_masks(cameras: Sequence[Camera], masks: Sequence[U8]) -> Sequence[U8]:
    if len(cameras) != len(masks):
        raise InputError(f"a visual hull needs one mask a camera, got {len(masks)} for {len(cameras)} cameras")
    for index, (camera, mask) in enumerate(zip(cameras, masks, strict=True)):
        if mask.ndim != 2 or mask.dtype != np.uint8 or min(mask.shape) < 2:
            raise InputError(f"mask {index} is {mask.shape} of {mask.dtype}; it needs (h, w) of uint8")
        width, height = camera.size
        # Rounding to whole pixels changes a resized image's aspect by up to one pixel.
        if abs(mask.shape[1] * height - mask.shape[0] * width) > max(width, height):
            raise InputError(f"mask {index} is {mask.shape[1]} x {mask.shape[0]}, no scaled {width} x {height} image")
    return masks


def _checked_bounds(bounds: ArrayLike, voxel: float) -> F64:
    corners = np.asarray(bounds, np.float64)
    if corners.shape != (2, 3) or not np.isfinite(corners).all() or not (corners[0] < corners[1]).all():
        raise InputError(f"the bounds are {corners.tolist()}; they need a finite low and high corner")
    if np.prod(np.ceil((corners[1] - corners[0]) / voxel) + 1) > _MAX_VOXELS:
        raise InputError(f"{_text(corners)} has too many voxels of {voxel:g} m; take larger voxels or closer bounds")
    return corners


def _text(corners: F64) -> str:
    size = corners[1] - corners[0]
    return f"the box of {size[0]:.2f} x {size[1]:.2f} x {size[2]:.2f} m"
