# SPDX-License-Identifier: Apache-2.0
"""What depth sensors get wrong: noise, steps, shadows, holes and flying pixels at edges, a blank border.

Three kinds are known by name. `structured` (a projected pattern, as Kinect v1 and Astra) and `stereo` (as RealSense)
measure disparity, so that noise and steps grow with the square of the depth and one side of whatever stands in front
has a shadow; `tof` (time of flight, as Azure Kinect) has little noise and more flying pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

from flowing_puppet_ros.arrays import F64

EDGE_JUMP_M = 0.05  # between neighbouring pixels, from which there is an edge
MIN_FACING_COSINE = 0.12  # surfaces seen at a flatter angle give no depth
SPECKLE_WIDTH_PX = 1.5  # of the holes in the middle of surfaces


@dataclass(frozen=True, slots=True)
class DepthSensor:
    """The errors of one kind of sensor.

    Attributes:
        baseline: metres between camera and projector or second camera; 0 for time of flight, which has no shadow.
        disparity_noise: pixels, standard deviation of the disparity.
        disparity_step: pixels, smallest difference of disparities.
        noise: metres, standard deviation that does not depend on the depth.
        correlation: pixels over which neighbouring values err together.
        flying: share of the pixels at edges whose value lies between both sides.
        edge_holes: share of the pixels at edges without a value.
        speckles: share of all other pixels without a value.
        min_range, max_range: metres.
        border: pixels without a value at the left, top, right and bottom, as after registration to a colour image.
    """

    baseline: float
    disparity_noise: float
    disparity_step: float
    noise: float
    correlation: float
    flying: float
    edge_holes: float
    speckles: float
    min_range: float
    max_range: float
    border: tuple[int, int, int, int] = (10, 6, 16, 4)


SENSORS = {
    "structured": DepthSensor(0.075, 0.08, 0.125, 0.001, 0.8, 0.06, 0.5, 0.002, 0.5, 8.0),
    "stereo": DepthSensor(0.05, 0.06, 1 / 32, 0.001, 2.0, 0.15, 0.4, 0.004, 0.3, 8.0),
    "tof": DepthSensor(0.0, 0.0, 0.0, 0.005, 0.0, 0.2, 0.4, 0.001, 0.25, 5.5),
}


def sense_depth(depth: F64, cosine: F64, focal: float, sensor: DepthSensor, rng: np.random.Generator) -> F64:
    """Return what a sensor makes of true depths, NaN where it has no value.

    Args:
        depth: (H, W) metres along the optical axis, infinite where nothing is.
        cosine: (H, W) cosine of the angle between the ray and the surface's normal.
        focal: pixels.
        sensor: the sensor's errors.
        rng: draws the errors.
    """
    sensed = depth.copy()
    edge = _find_edges(depth)
    flying = edge & (rng.random(depth.shape) < sensor.flying)
    near, far = minimum_filter(depth, 3), maximum_filter(np.where(np.isfinite(depth), depth, 0.0), 3)
    share = rng.random(depth.shape)
    sensed[flying] = ((1 - share) * near + share * far)[flying]
    if sensor.baseline > 0:
        sensed = _measure_disparity(sensed, focal * sensor.baseline, sensor, rng)
        sensed[find_shadow(depth, focal * sensor.baseline)] = np.nan
    sensed += sensor.noise * _draw_noise(rng, depth.shape, sensor.correlation)
    holes = edge & ~flying & (rng.random(depth.shape) < sensor.edge_holes)
    holes |= cosine < MIN_FACING_COSINE
    speckle = _draw_noise(rng, depth.shape, SPECKLE_WIDTH_PX)
    holes |= speckle < np.quantile(speckle, sensor.speckles)
    blank = np.ones(depth.shape, dtype=bool)
    left, top, right, bottom = sensor.border
    blank[top : depth.shape[0] - bottom, left : depth.shape[1] - right] = False
    known = np.isfinite(sensed) & (sensed > sensor.min_range) & (sensed < sensor.max_range)
    return np.where(known & ~holes & ~blank, sensed, np.nan)


def find_shadow(depth: F64, focal_baseline: float) -> np.ndarray:
    """Return the pixels (H, W) bool that a projector to the right of the camera does not reach.

    A pixel at column u and depth z lies at column u - f b / z of the projector; what lies right of a nearer pixel's
    column there, though left of it in the image, is behind it.
    """
    with np.errstate(divide="ignore"):
        column = np.arange(depth.shape[1]) - focal_baseline / depth
    behind = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    shadow = np.zeros(depth.shape, dtype=bool)
    shadow[:, :-1] = column[:, :-1] > behind[:, 1:]
    return shadow


def to_millimetres(depth: F64) -> np.ndarray:
    """Return depth in metres as uint16 millimetres (H, W), 0 where nothing is known, as drivers publish it."""
    return np.where(np.isfinite(depth), np.rint(1000 * np.nan_to_num(depth, posinf=0.0)), 0).astype(np.uint16)


def _find_edges(depth: F64) -> np.ndarray:
    limited = np.where(np.isfinite(depth), depth, 1e3)
    return np.asarray(maximum_filter(limited, 3) - minimum_filter(limited, 3) > EDGE_JUMP_M + 0.02 * limited)


def _measure_disparity(depth: F64, focal_baseline: float, sensor: DepthSensor, rng: np.random.Generator) -> F64:
    with np.errstate(divide="ignore"):
        disparity = focal_baseline / depth + sensor.disparity_noise * _draw_noise(rng, depth.shape, sensor.correlation)
        step = sensor.disparity_step
        return np.asarray(focal_baseline / np.maximum(step * np.round(disparity / step), 0.0))


def _draw_noise(rng: np.random.Generator, shape: tuple[int, ...], width: float) -> F64:
    """Draw Gaussian noise of unit deviation whose neighbours within `width` pixels are alike."""
    noise = rng.standard_normal(shape)
    if width > 0:
        noise = gaussian_filter(noise, width, mode="wrap")
        noise /= noise.std()
    return noise


def paint_depth(depth: F64, nearest: float = 0.5, farthest: float = 5.0) -> np.ndarray:
    """Return a picture (H, W, 3) RGB of depths: red is near, blue far, black unknown."""
    share = np.clip((np.nan_to_num(depth, nan=farthest) - nearest) / (farthest - nearest), 0, 1)
    picture = cv2.cvtColor(cv2.applyColorMap((255 * (1 - share)).astype(np.uint8), cv2.COLORMAP_JET), cv2.COLOR_BGR2RGB)
    return np.where(np.isfinite(depth)[..., None], picture, 0).astype(np.uint8)
