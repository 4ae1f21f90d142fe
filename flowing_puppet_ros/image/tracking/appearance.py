# SPDX-License-Identifier: Apache-2.0
"""Appearance of people: the colours of their torsos, which distinguish people who cross."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64, U8

TORSO_CORNERS = ("right_shoulder", "left_shoulder", "left_hip", "right_hip")
LIGHTNESS_BINS, TINT_BINS = 6, 20  # bins of lightness, and of each of a* and b* ...
TINT_WIDTH = 6.0  # ... which are so many CIE units wide, centred at grey
SMOOTHING_BINS = 1.0  # standard deviation of the blur, since lighting varies from place to place
INNER_SHARE = 0.75  # size of the middle of the torso that contains no background
MIN_PIXELS = 30  # of a histogram
MAX_SIDE_PX = 48  # larger torsos are subsampled


@dataclass(frozen=True, slots=True, eq=False)
class TorsoAppearance:
    """Histogram `colours` of a torso, summing to 1, and whether it is `isolated`: no other torso overlaps with it."""

    colours: F64
    isolated: bool


def torso_appearances(names: Sequence[str], image: U8, people: Sequence[F64]) -> list[TorsoAppearance | None]:
    """Measure the torso appearance of each person in an `image` (H, W, 3) RGB or (H, W) grey.

    `people` are joints (J, 2) px called `names`, NaN where unknown. None where a shoulder or a hip is unknown, or
    hardly any of the torso is in the image.
    """
    rows = [list(names).index(name) for name in TORSO_CORNERS]
    torsos = [joints[rows] for joints in people]
    colours = [_measure_colours(image, torso) if np.isfinite(torso).all() else None for torso in torsos]
    overlapping = find_overlapping(names, people)
    return [
        None if one is None else TorsoAppearance(one, not overlaps)
        for one, overlaps in zip(colours, overlapping, strict=True)
    ]


def find_overlapping(names: Sequence[str], people: Sequence[F64]) -> list[bool]:
    """Return whether each torso's bounding box overlaps with another's; `people` as for `torso_appearances`."""
    rows = [list(names).index(name) for name in TORSO_CORNERS]
    boxes = [(joints[rows].min(axis=0), joints[rows].max(axis=0)) for joints in people]

    def over(one: int, other: int) -> bool:
        (low, high), (low_other, high_other) = boxes[one], boxes[other]
        return bool((low <= high_other).all() and (low_other <= high).all())

    return [any(over(k, other) for other in range(len(boxes)) if other != k) for k in range(len(boxes))]


def hellinger_distance(one: F64, other: F64) -> float:
    """Return the Hellinger distance of two colour distributions (n,), in [0, 1]."""
    return float(np.sqrt(max(0.0, 1.0 - np.sqrt(one * other).sum())))


def _measure_colours(image: U8, torso: F64) -> F64 | None:
    """Return the smoothed histogram of the middle of a `torso` (4, 2) px, given by its corners in order."""
    middle = torso.mean(axis=0)
    corners = middle + INNER_SHARE * (torso - middle)
    size = np.array([image.shape[1], image.shape[0]])
    low = np.clip(np.floor(corners.min(axis=0)), 0, size).astype(int)
    high = np.clip(np.ceil(corners.max(axis=0)) + 1, 0, size).astype(int)
    if (high - low < 2).any():
        return None
    step = max(1, int((high - low).max()) // MAX_SIDE_PX)
    crop = np.ascontiguousarray(image[low[1] : high[1] : step, low[0] : high[0] : step])
    outline = np.rint((corners - low) / step).astype(np.int32)
    mask = cv2.fillConvexPoly(np.zeros(crop.shape[:2], np.uint8), outline, 1) > 0
    if np.count_nonzero(mask) < MIN_PIXELS:
        return None
    rgb = crop if crop.ndim == 3 else np.repeat(crop[..., None], 3, axis=2)
    lab = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB))[mask].astype(np.float64)
    level = np.clip(lab[:, 0] * LIGHTNESS_BINS / 256, 0, LIGHTNESS_BINS - 1).astype(np.intp)
    tint = np.clip((lab[:, 1:] - 128) / TINT_WIDTH + TINT_BINS / 2, 0, TINT_BINS - 1).astype(np.intp)
    bins = (level * TINT_BINS + tint[:, 0]) * TINT_BINS + tint[:, 1]
    counts = (
        np.bincount(bins, minlength=LIGHTNESS_BINS * TINT_BINS * TINT_BINS)
        .reshape(LIGHTNESS_BINS, TINT_BINS, TINT_BINS)
        .astype(np.float64)
    )
    smooth = np.stack([cv2.GaussianBlur(layer, (0, 0), SMOOTHING_BINS) for layer in counts])
    padded = np.pad(smooth, ((1, 1), (0, 0), (0, 0)))
    smooth = padded[:-2] + 2 * padded[1:-1] + padded[2:]
    return np.asarray((smooth / smooth.sum()).ravel())
