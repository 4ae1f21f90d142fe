# SPDX-License-Identifier: Apache-2.0
"""What people wear: the colours of their torsos, by which two who meet are told apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64, U8

CORNERS = ("right_shoulder", "left_shoulder", "left_hip", "right_hip")
LEVELS, TINTS = 6, 20  # bins of lightness, and of each of a* and b* ...
TINT_WIDTH = 6.0  # ... CIE units wide, about grey
SMOOTHING = 1.0  # bins; light changes from place to place
INSIDE = 0.75  # share of the torso, about its middle, that no background reaches
FEWEST = 30  # pixels
MOST = 48  # px a side; larger torsos are asked in some pixels only


@dataclass(frozen=True, slots=True, eq=False)
class TorsoAppearance:
    """Colours (LEVELS * TINTS^2,) of a torso that sum to 1, and whether nobody else's torso overlaps with it."""

    colours: F64
    alone: bool


def torso_appearances(names: Sequence[str], image: U8, people: Sequence[F64]) -> list[TorsoAppearance | None]:
    """What each of some people wears in an image (H, W, 3) RGB or (H, W) grey.

    `people` are joints (J, 2) px called `names`, NaN where unknown. None where a shoulder or a hip is unknown, or next
    to nothing of the torso is in the image.
    """
    rows = [list(names).index(name) for name in CORNERS]
    torsos = [joints[rows] for joints in people]
    colours = [_colours(image, torso) if np.isfinite(torso).all() else None for torso in torsos]
    met = find_overlapping(names, people)
    return [None if one is None else TorsoAppearance(one, not m) for one, m in zip(colours, met, strict=True)]


def find_overlapping(names: Sequence[str], people: Sequence[F64]) -> list[bool]:
    """Whether the box round each one's torso overlaps with that of another; `people` as for `clothes_of`."""
    rows = [list(names).index(name) for name in CORNERS]
    boxes = [(joints[rows].min(axis=0), joints[rows].max(axis=0)) for joints in people]

    def over(one: int, other: int) -> bool:
        (low, high), (low_other, high_other) = boxes[one], boxes[other]
        return bool((low <= high_other).all() and (low_other <= high).all())

    return [any(over(k, other) for other in range(len(boxes)) if other != k) for k in range(len(boxes))]


def hellinger_distance(one: F64, other: F64) -> float:
    """How unlike two colour distributions are, in [0, 1]: their Hellinger distance."""
    return float(np.sqrt(max(0.0, 1.0 - np.sqrt(one * other).sum())))


def _colours(image: U8, torso: F64) -> F64 | None:
    """Smoothed histogram of the middle of a torso (4, 2), its corners one after the other round it."""
    middle = torso.mean(axis=0)
    corners = middle + INSIDE * (torso - middle)
    size = np.array([image.shape[1], image.shape[0]])
    low = np.clip(np.floor(corners.min(axis=0)), 0, size).astype(int)
    high = np.clip(np.ceil(corners.max(axis=0)) + 1, 0, size).astype(int)
    if (high - low < 2).any():
        return None
    step = max(1, int((high - low).max()) // MOST)
    cut = np.ascontiguousarray(image[low[1] : high[1] : step, low[0] : high[0] : step])
    outline = np.rint((corners - low) / step).astype(np.int32)
    mask = cv2.fillConvexPoly(np.zeros(cut.shape[:2], np.uint8), outline, 1) > 0
    if np.count_nonzero(mask) < FEWEST:
        return None
    rgb = cut if cut.ndim == 3 else np.repeat(cut[..., None], 3, axis=2)
    lab = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB))[mask].astype(np.float64)
    level = np.clip(lab[:, 0] * LEVELS / 256, 0, LEVELS - 1).astype(np.intp)
    tint = np.clip((lab[:, 1:] - 128) / TINT_WIDTH + TINTS / 2, 0, TINTS - 1).astype(np.intp)
    bins = (level * TINTS + tint[:, 0]) * TINTS + tint[:, 1]
    counts = np.bincount(bins, minlength=LEVELS * TINTS * TINTS).reshape(LEVELS, TINTS, TINTS).astype(np.float64)
    smooth = np.stack([cv2.GaussianBlur(layer, (0, 0), SMOOTHING) for layer in counts])
    beside = np.pad(smooth, ((1, 1), (0, 0), (0, 0)))
    smooth = beside[:-2] + 2 * beside[1:-1] + beside[2:]
    return np.asarray((smooth / smooth.sum()).ravel())
