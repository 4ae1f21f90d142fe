# SPDX-License-Identifier: Apache-2.0
"""Colour terms of the image likelihood: skin, and the torso of this image, as histograms over CIE a*b*.

Thesis, "Likelihood" of the single-image chapter and "Image Likelihood" of the video chapter. The latter bins skin by
chroma and hue (L*C*h*), the same plane in polar coordinates; that told lower arms less well apart, so a*b* serves both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from flowing_puppet_ros.arrays import F64, U8, Array
from flowing_puppet_ros.evidence.image.features import as_rgb
from flowing_puppet_ros.evidence.image.region import RegionMap
from flowing_puppet_ros.model.ds.render import render_labels

BINS = 32
"""Bins a side of a histogram over a* and b*."""

LIMIT = 3.0
"""Logarithms of colour ratios are kept within this."""

_WIDTH = 4.0  # CIE units a bin
_SMOOTHING = 1.0  # bins
_RARE = 2e-3  # probability added to every bin: colours rarer than this tell nothing
_FEWEST = 20  # pixels; fewer make no histogram
_FACE = 0.6  # of the head's size


@dataclass(frozen=True, slots=True, eq=False)
class ColourImage:
    """The colour bin of every pixel (H,W), and how common each of the BINS^2 bins is in the image."""

    bins: NDArray[np.intp]
    histogram: F64

    @classmethod
    def of(cls, image: U8) -> Self:
        """Bin an RGB (H,W,3) or grey (H,W) uint8 image; InputError for anything else."""
        lab = cv2.cvtColor(np.asarray(as_rgb(image), np.float32) / np.float32(255.0), cv2.COLOR_RGB2LAB)
        a_and_b = np.clip(np.asarray(lab)[:, :, 1:] / _WIDTH + BINS / 2, 0, BINS - 1).astype(np.intp)
        bins = a_and_b[:, :, 0] * BINS + a_and_b[:, :, 1]
        return cls(bins, histogram_of(bins.ravel()))

    def inside(self, *contours: Array) -> F64 | None:
        """Histogram (BINS^2,) of the pixels in contours (K,2) px together; None where they cover next to nothing."""
        if not all(np.isfinite(contour).all() for contour in contours):
            return None
        covered = self.bins[render_labels(contours, range(len(contours)), self.bins.shape) > 0]
        return histogram_of(covered) if len(covered) >= _FEWEST else None

    def log_ratio(self, histogram: Array) -> F64:
        """Log of how much commoner each pixel's colour is in `histogram` (BINS^2,) than in the image, (H,W)."""
        return log_ratio(histogram, self.histogram)[self.bins]


@dataclass(frozen=True, slots=True, eq=False)
class SkinColour:
    """Log ratio (BINS^2,) of each colour on skin against elsewhere, learned over many images."""

    log_ratio: F64

    def map(self, colours: ColourImage, head: Array | None = None) -> RegionMap:
        """Log skin ratio of every pixel; with the contour `head` (K,2) px, its mean with that of the face's colours.

        People and lights differ, so the face of the image tells more about its hands than other people's skin does.
        """
        general = self.log_ratio[colours.bins]
        face = None if head is None else colours.inside(face_of(head))
        return RegionMap.of(general if face is None else 0.5 * (general + colours.log_ratio(face)))


def face_of(head: Array) -> Array:
    """The middle (K,2) of a head's contour (K,2), which neither hair nor neck nor background reaches."""
    middle = head.mean(axis=0)
    return np.asarray(middle + _FACE * (head - middle))


def torso_map(colours: ColourImage, torso: Array, head: Array) -> RegionMap:
    """Log ratio of the colours of the upper torso and the head, which sleeves or bare arms have too, (H,W).

    `torso` and `head`: contours (K,2) px. 0 everywhere when they cover next to nothing of the image.
    """
    quarter = len(torso) // 4
    upper = np.concatenate([torso[: quarter + 1], torso[-quarter:]])
    histogram = colours.inside(upper, head)
    return RegionMap.of(np.zeros(colours.bins.shape) if histogram is None else colours.log_ratio(histogram))


def histogram_of(bins: Array) -> F64:
    """Smoothed histogram (BINS^2,) of colour bins (n,), summing to 1."""
    counts = np.bincount(bins, minlength=BINS * BINS).reshape(BINS, BINS).astype(np.float64)
    smooth = np.asarray(cv2.GaussianBlur(counts, (0, 0), _SMOOTHING, borderType=cv2.BORDER_REPLICATE))
    return np.asarray(smooth.ravel() / smooth.sum())


def log_ratio(histogram: Array, other: Array) -> F64:
    """Logarithm (BINS^2,) of a histogram's ratio to another, within LIMIT, 0 for colours that are rare in both."""
    return np.asarray(np.clip(np.log((histogram + _RARE) / (other + _RARE)), -LIMIT, LIMIT))
