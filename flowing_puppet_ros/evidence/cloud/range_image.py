# SPDX-License-Identifier: Apache-2.0
"""A whole scan as its sensor saw it, from which the field of each person in it is made.

A depth image or an organised cloud is its own range image. Other scans are drawn into one: on a plane before the
sensor, as a camera's, or over azimuth and elevation, as a LiDAR's. How far such a sensor sees to each side is estimated
from what it saw.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import minimum_filter

from flowing_puppet_ros.arrays import F32, F64, I64, Bools
from flowing_puppet_ros.evidence.cloud.sensor_field import ANGULAR, PINHOLE, SensorField, SensorProjection

# Frames of organised clouds, as rows right, down and forward: optical, and x forward with z up (REP-103).
CAMERA_AXES = (np.eye(3), np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
MAX_CALIBRATION_POINTS, MIN_CALIBRATION_POINTS = 4000, 100
MAX_PIXEL_ERROR = 0.5  # of an organised cloud that a pinhole camera has seen, at the 99th percentile
MAX_BORDER_SHARE = 0.08
"""Share of the image's width or height within which the valid depth ends when it is that of a registered image."""
MAX_CAMERA_TANGENT = 1.2  # of half of a camera's field of view: 100 degrees from side to side
POINT_SPACINGS, MIN_PIXEL = 2.0, np.radians(0.2)  # of an estimated image's pixel, in mean spacings of points
END_PIXELS, MIN_END_SHARE = 2, 0.25
"""The field of view of an estimated image ends where so many of its lines end, within so many pixels."""
AZIMUTH_BINS = 720  # in which the largest gap of azimuth is found
MIN_GAP_RAD = np.radians(5.0)  # of azimuth without points, from which on a scan does not go all the way round


@dataclass(frozen=True, slots=True, eq=False)
class RangeImage:
    """A scan's range image.

    Attributes:
        projection: how places become pixels.
        bounds: (4,) as in `SensorField`; of an estimated image, the outermost pixels with points.
        depth: (H, W) of the nearest point in every pixel, metres; infinite without one.
        pixel: (N,) index into the flattened image of each of the scan's points.
        estimated: whether the scan was drawn into an image whose field of view is not known.
    """

    projection: SensorProjection
    bounds: F64
    depth: F32
    pixel: I64
    estimated: bool = False

    @classmethod
    def of_camera(cls, projection: SensorProjection, points: F64, pixel: I64, shape: tuple[int, int]) -> RangeImage:
        """Take a depth image of `shape` (H, W) with the pixels (N,) and places (N, 3) m of its valid depths, N > 0."""
        depth = np.full(shape, np.inf, dtype=np.float32)
        forward = projection.axes[2]
        depth.reshape(-1)[pixel] = points @ forward - projection.viewpoint @ forward
        return cls(projection, _find_border(np.isfinite(depth)), depth, pixel)

    @classmethod
    def of_organised(cls, points: F64, pixel: I64, shape: tuple[int, int]) -> RangeImage | None:
        """Take an organised cloud, whose calibration is found by least squares; None where no pinhole camera fits.

        `points` (N, 3) m are the finite ones and `pixel` (N,) their places in the flattened cloud of `shape` (H, W).
        """
        if min(shape) < 2 or len(points) < MIN_CALIBRATION_POINTS:
            return None
        chosen = np.linspace(0, len(points) - 1, min(len(points), MAX_CALIBRATION_POINTS)).astype(np.int64)
        places = np.stack([pixel[chosen] % shape[1], pixel[chosen] // shape[1]], axis=1).astype(np.float64)
        for axes in CAMERA_AXES:
            projection = _calibrate(points[chosen] @ axes.T, places, axes)
            if projection is not None:
                return cls.of_camera(projection, points, pixel, shape)
        return None

    @classmethod
    def of_scan(
        cls,
        points: F64,
        viewpoint: F64,
        azimuth: tuple[float, float] | None = None,
        elevation: tuple[float, float] | None = None,
    ) -> RangeImage:
        """Draw a scan (N, 3) m, z up, N > 0, into an image as seen from `viewpoint` (3,) m.

        `azimuth` and `elevation` are the lowest and highest angles in radians between which the sensor looks, counted
        from x to y and upwards; without them they are estimated.
        """
        local = points - viewpoint
        axes = None if azimuth or elevation else _find_camera_axes(local)
        kind = ANGULAR if axes is None else PINHOLE
        if axes is None:
            axes = _find_lidar_axes(local, azimuth)
        plain = SensorProjection(viewpoint, axes, np.ones(2), np.zeros(2), kind)
        coordinates, depth = plain.project(points)
        low, high = coordinates.min(axis=0), coordinates.max(axis=0)
        size = max(POINT_SPACINGS * float(np.sqrt(np.prod(high - low) / len(points))), MIN_PIXEL)
        projection = replace(plain, scale=np.full(2, 1 / size), offset=-low / size)
        columns, rows = np.floor((coordinates - low) / size + 0.5).astype(np.int64).T
        width, height = int(columns.max()) + 1, int(rows.max()) + 1
        image, pixel = np.full(width * height, np.inf, dtype=np.float32), rows * width + columns
        np.minimum.at(image, pixel, depth.astype(np.float32))
        bounds = np.array([-0.5, -0.5, width - 0.5, height - 0.5])
        estimated = not (azimuth or elevation)
        if not estimated:
            bounds = _take_given(projection, azimuth, elevation)
        return cls(projection, bounds, image.reshape(height, width), pixel, estimated)

    def take(self, rows: I64 | Bools) -> RangeImage:
        """Return the same image for some of the scan's points."""
        return replace(self, pixel=self.pixel[rows])

    def thin(self, rows: I64) -> RangeImage:
        """Return the image of an even part `rows` of the scan's points, without the depths of the others.

        Nobody says whose those are: a person's own would hide what is behind them.
        """
        depth = np.full_like(self.depth, np.inf)
        pixel = self.pixel[rows]
        depth.reshape(-1)[pixel] = self.depth.reshape(-1)[pixel]
        return replace(self, depth=depth, pixel=pixel)

    def turn(self, rotation: F64) -> RangeImage:
        """Return the same image in a frame that `rotation` (3, 3) leads to."""
        return replace(self, projection=self.projection.turn(rotation))

    def move(self, step: F64) -> RangeImage:
        """Return the same image in a frame in which everything is moved by `step` (3,) m."""
        return replace(self, projection=self.projection.move(step))

    def make_field(self, rows: I64 | Bools | slice) -> SensorField:
        """Return what the sensor can know of the person whose points are the scan's `rows`."""
        own = self.pixel[rows]
        limit = self.depth.copy()
        limit.reshape(-1)[own] = np.inf
        bounds = self.bounds
        if self.projection.kind == ANGULAR or self.estimated:
            if self.estimated:
                bounds = self._find_ends(np.isfinite(limit))
            # Between the rings of a LiDAR what it hit in the next one hides too.
            limit = np.where(np.isfinite(self.depth), limit, minimum_filter(limit, 3))
        return SensorField(self.projection, bounds, limit)

    def _find_ends(self, others: Bools) -> F64:
        """Return the bounds of the field of view by the pixels (H, W) of all but the person; infinite where it is open.

        The person alone says nothing about where the field ends, and few lines that happen to end together little.
        """
        ends = [*_find_line_ends(others), *_find_line_ends(others.T)]
        left, right, top, bottom = (
            side if np.isfinite(end) else end for end, side in zip(ends, self.bounds[[0, 2, 1, 3]], strict=True)
        )
        if self.projection.kind == ANGULAR and self._gap() < MIN_GAP_RAD:
            left, right = -np.inf, np.inf
        return np.array([left, top, right, bottom])

    def _gap(self) -> float:
        """Return the azimuth without points, radians."""
        return float(2 * np.pi - (self.depth.shape[1] - 1) / self.projection.scale[0])


def _find_border(valid: Bools) -> F64:
    """Return the bounds of an image (H, W): its border, or that of its valid depth, which may end a little inside."""
    bounds = np.array([-0.5, -0.5, valid.shape[1] - 0.5, valid.shape[0] - 0.5])
    for axis in (0, 1):
        used = np.flatnonzero(valid.any(axis=axis))
        margin = MAX_BORDER_SHARE * valid.shape[1 - axis]
        if used[0] < margin:
            bounds[axis] = used[0] - 0.5
        if valid.shape[1 - axis] - 1 - used[-1] < margin:
            bounds[axis + 2] = used[-1] + 0.5
    return bounds


def _calibrate(local: F64, pixels: F64, axes: F64) -> SensorProjection | None:
    """Return the pinhole camera that sees places (K, 3) m, right, down and forward, at pixels (K, 2), or None."""
    if not (local[:, 2] > 0).all():
        return None
    scale, offset = np.empty(2), np.empty(2)
    for axis in (0, 1):
        table = np.stack([local[:, axis] / local[:, 2], np.ones(len(local))], axis=1)
        solution = np.linalg.lstsq(table, pixels[:, axis], rcond=None)[0]
        error = np.abs(table @ solution - pixels[:, axis])
        if solution[0] <= 0 or np.percentile(error, 99) > MAX_PIXEL_ERROR:
            return None
        scale[axis], offset[axis] = solution
    return SensorProjection(np.zeros(3), axes, scale, offset, PINHOLE)


def _find_camera_axes(local: F64) -> F64 | None:
    """Return rows right, down and forward where places (N, 3) m lie ahead along an axis as a camera's do, else None."""
    few = local[:: 1 + len(local) // MAX_CALIBRATION_POINTS]
    mean = (few / np.maximum(np.linalg.norm(few, axis=1, keepdims=True), 1e-9)).mean(axis=0)
    ahead = int(np.abs(mean).argmax())
    forward = np.eye(3)[ahead] * np.sign(mean[ahead])
    i, j = (axis for axis in range(3) if axis != ahead)
    # A few points tell most LiDARs.
    for some in (few, local):
        limit = MAX_CAMERA_TANGENT * np.sign(mean[ahead]) * some[:, ahead]
        if not ((np.abs(some[:, i]) < limit) & (np.abs(some[:, j]) < limit)).all():
            return None
    down = np.array([0.0, 0.0, -1.0]) if ahead != 2 else np.array([-1.0, 0.0, 0.0])
    return np.stack([np.cross(down, forward), down, forward])


def _find_lidar_axes(local: F64, azimuth: tuple[float, float] | None) -> F64:
    """Return rows right, down and forward, level, forward opposite to the largest gap of azimuth or amid the given."""
    if azimuth is not None:
        middle = (azimuth[0] + azimuth[1]) / 2
    else:
        bins = np.floor((np.arctan2(local[:, 1], local[:, 0]) + np.pi) / (2 * np.pi) * AZIMUTH_BINS).astype(np.int64)
        angles = np.flatnonzero(np.bincount(bins)) * (2 * np.pi / AZIMUTH_BINS) - np.pi
        gaps = np.diff(angles, append=angles[0] + 2 * np.pi)
        widest = int(gaps.argmax())
        middle = angles[widest] + gaps[widest] / 2 + np.pi
    forward, down = np.array([np.cos(middle), np.sin(middle), 0.0]), np.array([0.0, 0.0, -1.0])
    return np.stack([np.cross(down, forward), down, forward])


def _take_given(
    projection: SensorProjection, azimuth: tuple[float, float] | None, elevation: tuple[float, float] | None
) -> F64:
    """Return the bounds in pixels of the given angles in radians."""
    bounds = np.array([-np.inf, -np.inf, np.inf, np.inf])
    if azimuth is not None and azimuth[1] - azimuth[0] < 2 * np.pi - MIN_GAP_RAD:
        half = (azimuth[1] - azimuth[0]) / 2
        bounds[[0, 2]] = np.array([-half, half]) * projection.scale[0] + projection.offset[0]
    if elevation is not None:
        bounds[[1, 3]] = -np.array(elevation[::-1]) * projection.scale[1] + projection.offset[1]
    return bounds


def _find_line_ends(occupied: Bools) -> tuple[float, float]:
    """Return 0 for the first and the last column of an image where many of its rows end there, else infinity."""
    lines = occupied[occupied.any(axis=1)]
    if not len(lines):
        return -np.inf, np.inf
    first, last = lines.argmax(axis=1), lines[:, ::-1].argmax(axis=1)
    return (
        0.0 if (first < END_PIXELS).mean() >= MIN_END_SHARE else -np.inf,
        0.0 if (last < END_PIXELS).mean() >= MIN_END_SHARE else np.inf,
    )
