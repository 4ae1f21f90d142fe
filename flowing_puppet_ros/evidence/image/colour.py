# SPDX-License-Identifier: Apache-2.0
"""Colour terms of the image likelihood: skin, and the torso of this image, as histograms over CIE a*b*.

Thesis, "Likelihood" of the single-image chapter and "Image Likelihood" of the video chapter. The latter bins skin by
chroma and hue (L*C*h*), the same plane in polar coordinates. That discriminated lower arms less well, so both use a*b*.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from flowing_puppet_ros.arrays import F64, U8, Array
from flowing_puppet_ros.evidence.image.region import RegionMap
from flowing_puppet_ros.images import as_rgb
from flowing_puppet_ros.model.ds.render import render_labels

BINS = 32
"""Bins per axis of a histogram over a* and b*."""

MAX_LOG_RATIO = 3.0
"""Bound of the logarithms of colour ratios."""

_BIN_WIDTH = 4.0  # CIE units per bin
_SMOOTHING = 1.0  # bins: standard deviation of the blur of a histogram
_PROBABILITY_FLOOR = 2e-3  # added to every bin: colours rarer than this carry no information
_MIN_PIXELS = 20  # of a histogram
_FACE_SHARE = 0.6  # size of the face relative to the head's


@dataclass(frozen=True, slots=True, eq=False)
class ColourImage:
    """Colour bin of every pixel, `bins` (H, W), and how common each bin is in the image, `histogram` (BINS^2,)."""

    bins: NDArray[np.intp]
    histogram: F64

    @classmethod
    def of(cls, image: U8) -> Self:
        """Bin an RGB (H, W, 3) or grey (H, W) uint8 image; InputError for anything else."""
        lab = cv2.cvtColor(np.asarray(as_rgb(image), np.float32) / np.float32(255.0), cv2.COLOR_RGB2LAB)
        a_and_b = np.clip(np.asarray(lab)[:, :, 1:] / _BIN_WIDTH + BINS / 2, 0, BINS - 1).astype(np.intp)
        bins = a_and_b[:, :, 0] * BINS + a_and_b[:, :, 1]
        return cls(bins, smooth_histogram(bins.ravel()))

    def histogram_inside(self, *contours: Array) -> F64 | None:
        """Return the histogram (BINS^2,) of the pixels inside `contours` (K, 2) px; None if they cover next to none."""
        if not all(np.isfinite(contour).all() for contour in contours):
            return None
        covered = self.bins[render_labels(contours, range(len(contours)), self.bins.shape) > 0]
        return smooth_histogram(covered) if len(covered) >= _MIN_PIXELS else None

    def log_ratio(self, histogram: Array) -> F64:
        """Return the log ratio (H, W) of each pixel's colour in `histogram` (BINS^2,) to that in the image."""
        return log_ratio(histogram, self.histogram)[self.bins]


@dataclass(frozen=True, slots=True, eq=False)
class SkinColour:
    """Log ratio (BINS^2,) of each colour on skin to that elsewhere, learned over many images."""

    log_ratio: F64

    def map(self, colours: ColourImage, head: Array | None = None) -> RegionMap:
        """Map the log skin ratio of every pixel; given the contour `head` (K, 2) px, average in the face's colours.

        People and lighting differ, so the face in the image says more about its hands than other people's skin does.
        """
        general = self.log_ratio[colours.bins]
        face = None if head is None else colours.histogram_inside(face_contour(head))
        return RegionMap.of(general if face is None else 0.5 * (general + colours.log_ratio(face)))


def face_contour(head: Array) -> Array:
    """Return the middle (K, 2) of a head's contour `head` (K, 2), without hair, neck and background."""
    middle = head.mean(axis=0)
    return np.asarray(middle + _FACE_SHARE * (head - middle))


def torso_map(colours: ColourImage, torso: Array, head: Array) -> RegionMap:
    """Map the log ratio (H, W) of the colours of the upper torso and the head, which sleeves or bare arms share.

    `torso` and `head` are contours (K, 2) px. The map is 0 if they cover next to nothing of the image.
    """
    quarter = len(torso) // 4
    upper = np.concatenate([torso[: quarter + 1], torso[-quarter:]])
    histogram = colours.histogram_inside(upper, head)
    return RegionMap.of(np.zeros(colours.bins.shape) if histogram is None else colours.log_ratio(histogram))


def smooth_histogram(bins: Array) -> F64:
    """Return the smoothed histogram (BINS^2,), summing to 1, of colour `bins` (n,)."""
    counts = np.bincount(bins, minlength=BINS * BINS).reshape(BINS, BINS).astype(np.float64)
    smooth = np.asarray(cv2.GaussianBlur(counts, (0, 0), _SMOOTHING, borderType=cv2.BORDER_REPLICATE))
    return np.asarray(smooth.ravel() / smooth.sum())


def log_ratio(histogram: Array, other: Array) -> F64:
    """Return the log ratio (BINS^2,) of two histograms, within MAX_LOG_RATIO; near 0 for colours rare in both."""
    return np.asarray(
        np.clip(np.log((histogram + _PROBABILITY_FLOOR) / (other + _PROBABILITY_FLOOR)), -MAX_LOG_RATIO, MAX_LOG_RATIO)
    )
