# SPDX-License-Identifier: Apache-2.0
"""Affine motion of each labelled region, fitted robustly to dense flow.

A motion is a (2, 3) array A that takes a point of the first image to the second: p' = A [x, y, 1]^T. The thesis fits
one to the flow inside every visible part (flowing puppets, section 2). Here it is fitted by iteratively reweighted
least squares with a Geman-McClure weight, starting from the median translation. Each flow vector is also weighted by
its round trip through the backward flow. A part's outline always includes some background, so vectors that the
background's motion explains weigh less in the parts. This matters where a limb moves and changes nothing elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from flowing_puppet_ros.arrays import F64, I64, U16, Bools, Flow

SAMPLES_PER_REGION = 2000  # larger regions are subsampled to about this many flow vectors
MEDIAN_SAMPLES = 200  # flow vectors from which the initial translation is taken
ITERATIONS = 8  # of reweighted least squares
MIN_AFFINE_SAMPLES = 40  # regions of fewer get a translation
MIN_TRANSLATION_SAMPLES = 8  # regions of fewer get no motion of their own
MIN_SCALE_PX = 1.0  # of the robust weight: flow noise that no fit should try to beat
LINEAR_PRIOR_SD = 0.3  # expected size of A's linear part beside the identity
PIXELS_PER_OBSERVATION = 50.0  # neighbouring flow vectors err together: this many count as one
BACKGROUND_WEIGHT = 0.3  # of a part's vector that moves exactly as the background does


@dataclass(frozen=True, slots=True, eq=False)
class RegionMotions:
    """Motions of R regions.

    Attributes:
        affine: (R, 2, 3) motions.
        residual: (R,) px, root mean square misfit of the inliers; infinite without any.
        support: (R,) in [0, 1], the share of the region's sampled vectors that agree with the motion.
        pixels: (R,) number of visible pixels with known flow.
    """

    affine: F64
    residual: F64
    support: F64
    pixels: I64

    @property
    def known(self) -> Bools:
        """Regions (R,) with enough pixels for a motion of their own."""
        return self.pixels >= MIN_TRANSLATION_SAMPLES


def apply_affine(affine: F64, points: F64) -> F64:
    """Apply motions `affine` (..., 2, 3) to `points` (..., N, 2) px."""
    transformed: F64 = points @ np.swapaxes(affine[..., :2], -1, -2) + affine[..., None, :, 2]
    return transformed


def fit_regions(labels: NDArray[np.unsignedinteger], count: int, forward: Flow, backward: Flow | None) -> RegionMotions:
    """Fit one motion to each of the labels 0 .. count - 1 of `labels` (H, W), over the pixels with known flow.

    Label 0 is the background, the others are in front of it. By the pixels of a region:
        MIN_AFFINE_SAMPLES or more           an affine motion
        MIN_TRANSLATION_SAMPLES or more      a translation
        fewer                                the identity, and `known` is False
    """
    back = backward if backward is not None else np.empty((0, 0, 2), np.float32)
    regions = np.ascontiguousarray(labels, dtype=np.uint16)
    samples, starts, pixels = _gather(regions, count, np.ascontiguousarray(forward), np.ascontiguousarray(back))
    affine = np.empty((count, 2, 3))
    residual, support = np.empty(count), np.empty(count)
    _fit_all(samples, starts, affine, residual, support)
    return RegionMotions(affine, residual, support, pixels)


@njit(cache=True, nogil=True)
def round_trip_weight(x: int, y: int, u: float, v: float, backward: Flow) -> float:
    """Return the weight in (0, 1] of a flow vector: 1 when the backward flow returns to where it came from."""
    height, width = backward.shape[:2]
    if height == 0:
        return 1.0
    there_x, there_y = x + u, y + v
    if not (0.0 <= there_x < width - 1 and 0.0 <= there_y < height - 1):
        return 0.25
    left, top = int(there_x), int(there_y)
    a, b = there_x - left, there_y - top
    error, magnitude = 0.0, u * u + v * v
    for axis in range(2):
        upper = (1 - a) * backward[top, left, axis] + a * backward[top, left + 1, axis]
        lower = (1 - a) * backward[top + 1, left, axis] + a * backward[top + 1, left + 1, axis]
        back = (1 - b) * upper + b * lower
        magnitude += back * back
        error += ((u if axis == 0 else v) + back) ** 2
    if not np.isfinite(error):
        return 0.25
    tolerance = 0.01 * magnitude + 0.5  # Sundaram et al. 2010
    return tolerance / (tolerance + error)


@njit(cache=True, nogil=True)
def _gather(labels: U16, count: int, forward: Flow, backward: Flow) -> tuple[F64, I64, I64]:
    """Return samples (M, 6) sorted by label, the first of each label (count + 1,) and the labels' pixels (count,).

    A sample is x, y, u, v, how well its round trip closes in (0, 1], and its weight in a fit, initially the same.
    """
    height, width = labels.shape
    pixels = np.zeros(count, np.int64)
    for y in range(height):
        for x in range(width):
            if labels[y, x] < count and np.isfinite(forward[y, x, 0]) and np.isfinite(forward[y, x, 1]):
                pixels[labels[y, x]] += 1
    step = np.maximum(1, pixels // SAMPLES_PER_REGION)
    starts = np.zeros(count + 1, np.int64)
    for region in range(count):
        starts[region + 1] = starts[region] + (pixels[region] + step[region] - 1) // step[region]
    samples = np.empty((starts[count], 6))
    seen = np.zeros(count, np.int64)
    for y in range(height):
        for x in range(width):
            region = labels[y, x]
            u, v = forward[y, x, 0], forward[y, x, 1]
            if region >= count or not (np.isfinite(u) and np.isfinite(v)):
                continue
            if seen[region] % step[region] == 0:
                row = samples[starts[region] + seen[region] // step[region]]
                row[0], row[1], row[2], row[3] = x, y, u, v
                row[4] = row[5] = round_trip_weight(x, y, u, v, backward)
            seen[region] += 1
    return samples, starts, pixels


@njit(cache=True, nogil=True)
def _fit_all(samples: F64, starts: I64, affine: F64, residual: F64, support: F64) -> None:
    """Fit the background, label 0; then discount the vectors of the other regions that move with it, and fit those."""
    residual[0], support[0] = _fit(samples[: starts[1]], affine[0])
    a = affine[0]
    for k in range(starts[1], len(samples)):
        x, y = samples[k, 0], samples[k, 1]
        misfit_x = a[0, 0] * x + a[0, 1] * y + a[0, 2] - x - samples[k, 2]
        misfit_y = a[1, 0] * x + a[1, 1] * y + a[1, 2] - y - samples[k, 3]
        square = (misfit_x * misfit_x + misfit_y * misfit_y) / MIN_SCALE_PX**2
        samples[k, 5] *= (BACKGROUND_WEIGHT + square) / (1.0 + square)
    for region in range(1, len(starts) - 1):
        residual[region], support[region] = _fit(samples[starts[region] : starts[region + 1]], affine[region])


@njit(cache=True, nogil=True)
def _fit(samples: F64, affine: F64) -> tuple[float, float]:
    """Write the robust motion of `samples` (M, 6) into `affine` (2, 3); return residual and support."""
    affine[:] = 0.0
    affine[0, 0] = affine[1, 1] = 1.0
    if len(samples) < MIN_TRANSLATION_SAMPLES:
        return np.inf, 0.0
    centre_x, centre_y = np.mean(samples[:, 0]), np.mean(samples[:, 1])
    radius = max(1.0, np.sqrt(np.var(samples[:, 0]) + np.var(samples[:, 1])))
    # Columns: translation, then the linear part in units of the region's radius.
    motion = np.zeros((2, 3))
    start = samples[:: max(1, len(samples) // MEDIAN_SAMPLES)]
    for axis in range(2):
        motion[axis, 0] = _weighted_median(start[:, 2 + axis], start[:, 5])
    distance = np.abs(start[:, 2] - motion[0, 0]) + np.abs(start[:, 3] - motion[1, 0])
    scale = max(MIN_SCALE_PX, 1.5 * _weighted_median(distance, start[:, 5]))
    linear = len(samples) >= MIN_AFFINE_SAMPLES
    for _ in range(ITERATIONS):
        _reweight_and_solve(samples, centre_x, centre_y, radius, scale, linear, motion)
        scale = max(MIN_SCALE_PX, 0.7 * scale)
    affine[:, :2] += motion[:, 1:] / radius
    affine[:, 2] = motion[:, 0] - (motion[:, 1] * centre_x + motion[:, 2] * centre_y) / radius
    return _measure_agreement(samples, centre_x, centre_y, radius, scale, motion)


@njit(cache=True, nogil=True)
def _weighted_median(values: F64, weights: F64) -> float:
    """Return the smallest value up to which (inclusive) half of the weight lies."""
    order = np.argsort(values)
    half, below = 0.5 * np.sum(weights), 0.0
    for k in order:
        below += weights[k]
        if below >= half:
            return float(values[k])
    return float(values[order[-1]])


@njit(cache=True, nogil=True)
def _reweight_and_solve(
    samples: F64, centre_x: float, centre_y: float, radius: float, scale: float, linear: bool, motion: F64
) -> None:
    """Weight every sample by its misfit to `motion` (2, 3), then solve for a new `motion`: one iteration."""
    normal, right = np.zeros((3, 3)), np.zeros((3, 2))
    for k in range(len(samples)):
        x, y = (samples[k, 0] - centre_x) / radius, (samples[k, 1] - centre_y) / radius
        u, v = samples[k, 2], samples[k, 3]
        misfit_x = u - motion[0, 0] - motion[0, 1] * x - motion[0, 2] * y
        misfit_y = v - motion[1, 0] - motion[1, 1] * x - motion[1, 2] * y
        w = samples[k, 5] / (1.0 + (misfit_x * misfit_x + misfit_y * misfit_y) / (scale * scale)) ** 2
        normal[0, 0] += w
        normal[0, 1] += w * x
        normal[0, 2] += w * y
        normal[1, 1] += w * x * x
        normal[1, 2] += w * x * y
        normal[2, 2] += w * y * y
        right[0, 0] += w * u
        right[0, 1] += w * v
        right[1, 0] += w * x * u
        right[1, 1] += w * x * v
        right[2, 0] += w * y * u
        right[2, 1] += w * y * v
    if normal[0, 0] <= 1e-9:
        return
    if not linear:
        motion[:, 0] = right[0] / normal[0, 0]
        return
    normal[1, 0], normal[2, 0], normal[2, 1] = normal[0, 1], normal[0, 2], normal[1, 2]
    prior = PIXELS_PER_OBSERVATION * (MIN_SCALE_PX / (LINEAR_PRIOR_SD * radius)) ** 2
    normal[1, 1] += prior
    normal[2, 2] += prior
    motion[:] = np.linalg.solve(normal, right).T


@njit(cache=True, nogil=True)
def _measure_agreement(
    samples: F64, centre_x: float, centre_y: float, radius: float, scale: float, motion: F64
) -> tuple[float, float]:
    """Return a motion's residual (px, root mean square over the inliers) and support (their share, by round trip)."""
    total, inlier, squares = 0.0, 0.0, 0.0
    for k in range(len(samples)):
        x, y = (samples[k, 0] - centre_x) / radius, (samples[k, 1] - centre_y) / radius
        misfit_x = samples[k, 2] - motion[0, 0] - motion[0, 1] * x - motion[0, 2] * y
        misfit_y = samples[k, 3] - motion[1, 0] - motion[1, 1] * x - motion[1, 2] * y
        square = misfit_x * misfit_x + misfit_y * misfit_y
        total += 1.0
        if square < 9.0 * scale * scale:
            inlier += samples[k, 4]
            squares += samples[k, 4] * square
    return np.sqrt(squares / inlier) if inlier > 0 else np.inf, inlier / total
