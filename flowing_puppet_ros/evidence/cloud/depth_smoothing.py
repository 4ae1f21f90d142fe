# SPDX-License-Identifier: Apache-2.0
"""Noise of depth images averaged over neighbouring pixels of one person.

The error of stereo and of projected patterns grows with the square of the depth: 1 cm at 2 m is 9 cm at 6 m, more than
a limb is thick and several times the distance between points. Normals of such points point anywhere, and what a surface
hides is decided by chance; with 1 cm at 2 m, nearly as large as the distance between points, they waver. It is an error
along the ray, so depth is fitted over the image, not a plane through points.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F64, I64, Bools
from flowing_puppet_ros.evidence.cloud.range_image import RangeImage
from flowing_puppet_ros.evidence.cloud.sensor_field import PINHOLE

RADIUS_M, MAX_WINDOW_PX = 0.03, 7
"""Half of the window in which depths are averaged, at most: less than the radius of most limbs."""
MIN_NOISE_M, WANTED_NOISE_M = 0.008, 0.004
"""Deviation from which on depths are averaged, and that which is left by windows that need not be larger."""
SAME_SURFACE_NOISES, MIN_SAME_SURFACE_M, ROUNDS = 3.0, 0.02, 2
"""Deviations of the noise from the surface, and metres, within which depths in the window belong to it."""
SECOND_DIFFERENCE = np.sqrt(1.5)
"""Deviation of a depth from the mean of its two neighbours, for independent errors of deviation 1."""
TO_DEVIATION = 1.4826  # from the median of absolute values of a Gaussian


def smooth_depth(image: RangeImage, points: F64, own: Bools | I64 | slice) -> F64:
    """Return a person's points (K, 3) m of a scan (N, 3) m, each moved along its ray onto the surface around it.

    Only those of depth images are; a LiDAR's points are farther apart than its noise.

    Args:
        image: the range image of the scan.
        points: the scan.
        own: which of its points are the person's.
    """
    chosen = points[own]
    if image.projection.kind != PINHOLE or image.estimated or not len(chosen):
        return chosen
    pixel = image.pixel[own]
    depth = np.full(image.depth.shape, np.nan)
    depth.reshape(-1)[pixel] = image.depth.reshape(-1)[pixel]
    noise = _measure_noise(depth, pixel)
    if noise <= MIN_NOISE_M:
        return chosen
    focal = float(image.projection.scale.mean())
    pixels = np.ceil(np.sqrt((noise / WANTED_NOISE_M) ** 2 / np.pi))
    smooth = _smooth(depth, pixel, noise, focal, int(min(pixels, MAX_WINDOW_PX)))
    share = smooth / depth.reshape(-1)[pixel]
    return image.projection.viewpoint + (chosen - image.projection.viewpoint) * share[:, None]


@njit(cache=True, nogil=True)
def _measure_noise(depth: F64, pixel: I64) -> float:
    """Return the deviation of the depths (H, W) m at `pixel` (K,) from those beside them; 0 where nobody knows."""
    height, width = depth.shape
    found, count = np.empty(2 * len(pixel)), 0
    for own in pixel:
        row, column = own // width, own % width
        if 0 < column < width - 1:
            gap = depth[row, column] - 0.5 * (depth[row, column - 1] + depth[row, column + 1])
            if not np.isnan(gap):
                found[count], count = abs(gap), count + 1
        if 0 < row < height - 1:
            gap = depth[row, column] - 0.5 * (depth[row - 1, column] + depth[row + 1, column])
            if not np.isnan(gap):
                found[count], count = abs(gap), count + 1
    if count == 0:
        return 0.0
    return float(TO_DEVIATION * np.median(found[:count]) / SECOND_DIFFERENCE)


@njit(cache=True, nogil=True)
def _smooth(depth: F64, pixel: I64, noise: float, focal: float, most: int) -> F64:
    """Return the depth (K,) m at each `pixel` of the plane in the image that fits the depths (H, W) m around it."""
    height, width = depth.shape
    result = np.empty(len(pixel))
    limit = max(SAME_SURFACE_NOISES * noise, MIN_SAME_SURFACE_M)
    for k in range(len(pixel)):
        row, column = pixel[k] // width, pixel[k] % width
        middle = depth[row, column]
        window = min(max(int(RADIUS_M * focal / middle + 0.5), 1), most)
        for _ in range(ROUNDS):
            n, su, sv, sz = 0, 0.0, 0.0, 0.0
            suu, svv, suv, suz, svz = 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(max(row - window, 0), min(row + window + 1, height)):
                for j in range(max(column - window, 0), min(column + window + 1, width)):
                    z = depth[i, j] - middle
                    # Not so for pixels of others, whose depth is NaN.
                    if abs(z) <= limit:
                        u, v = float(j - column), float(i - row)
                        n, su, sv, sz = n + 1, su + u, sv + v, sz + z
                        suu, svv, suv = suu + u * u, svv + v * v, suv + u * v
                        suz, svz = suz + u * z, svz + v * z
            middle += _fit_middle(n, su, sv, sz, suu, svv, suv, suz, svz)
        result[k] = middle
    return result


@njit(cache=True, inline="always")
def _fit_middle(n, su, sv, sz, suu, svv, suv, suz, svz):  # type: ignore[no-untyped-def]
    """Return the value at (0, 0) of the plane over (u, v) through `n` values z of these sums; their mean where flat."""
    if n == 0:
        return 0.0
    mu, mv, mz = su / n, sv / n, sz / n
    uu, vv, uv = suu - n * mu * mu, svv - n * mv * mv, suv - n * mu * mv
    uz, vz = suz - n * mu * mz, svz - n * mv * mz
    size = uu * vv - uv * uv
    if n < 4 or size < 1e-6:
        return mz
    return mz - (vv * uz - uv * vz) / size * mu - (uu * vz - uv * uz) / size * mv
