# SPDX-License-Identifier: Apache-2.0
"""Contour term of the image likelihood: steered HOG descriptors, a calibrated linear SVM per part (Eqs. 20-22)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from flowing_puppet_ros.arrays import F32, F64, Array, Bools
from flowing_puppet_ros.evidence.image.features import CHANNELS, ImageFeatures
from flowing_puppet_ros.evidence.image.outline import mirror_order
from flowing_puppet_ros.evidence.image.steered_hog import SIDES, descriptors
from flowing_puppet_ros.model.tree import mirrored_name

CELL_METRES = 0.03
"""Side of a cell of the finest level (Eq. 22; the thesis says 0.02 of the image's height at scale 1)."""

LEVELS = 3
"""Levels of the pyramid; each has cells twice as wide as the last."""

PLACES = {"torso": 40, "head": 20, "upper_arm": 14, "lower_arm": 20}
"""Positions along the contour of each kind of part; with three descriptors each, as many as in the thesis."""


def part_kind(part: str) -> str:
    """Return the kind of a part, for which left and right share what is learned: "upper_arm" of "left_upper_arm"."""
    return part.removeprefix("right_").removeprefix("left_")


def order_as_right(part: str, contours: Array) -> Array:
    """Return `contours` (..., K, 2) of a part with their points in the order of the part on the person's right."""
    return mirror_order(contours) if mirrored_name(part) != part and part.startswith("left_") else contours


def describe(features: ImageFeatures, contours: Array, places: int, scale: Array) -> tuple[F32, Bools]:
    """Describe `contours` (P, K, 2) px at `scale` (P,) px/m.

    Returns descriptors (P, LEVELS, places, SIDES, CHANNELS), and which of them (P, LEVELS, places, SIDES) are visible.
    The `places` are spread evenly over the contour's points. Cells grow with the scale (Eq. 22), and at every level the
    descriptors inside and outside are one cell away from the contour.
    """
    chosen = np.arange(places) * contours.shape[1] // places
    found = np.zeros((len(contours), LEVELS, places, SIDES, CHANNELS), np.float32)
    visible = np.zeros(found.shape[:-1], np.bool_)
    for step in range(LEVELS):
        cell = CELL_METRES * 2**step * np.asarray(scale, np.float64)
        numbers = features.find_levels(cell)
        for number in np.unique(numbers):
            here = numbers == number
            level = features.level(int(number))
            found[here, step], visible[here, step] = descriptors(level, contours[here], chosen, cell[here])
    return found, visible


@dataclass(frozen=True, slots=True, eq=False)
class ContourFilter:
    """Learned contour model of one kind of part.

    `weights` (LEVELS, places, SIDES, CHANNELS) and `bias` are the linear SVM. `unseen` (LEVELS, places, SIDES) is the
    contribution of a descriptor outside the image, its mean over positive and negative examples. `calibration` holds
    a_i and b_i of Eq. 21.
    """

    weights: F32
    unseen: F32
    bias: float
    calibration: tuple[float, float]

    @classmethod
    def from_arrays(cls, kind: str, arrays: Mapping[str, Array]) -> Self:
        """Build from the arrays of one kind of part in a likelihood file."""
        bias, a, b = (float(value) for value in arrays[f"{kind}_calibration"])
        return cls(arrays[f"{kind}_weights"], arrays[f"{kind}_unseen"], bias, (a, b))

    def to_arrays(self, kind: str) -> dict[str, Array]:
        """Return the arrays that `from_arrays` reads."""
        calibration = np.array([self.bias, *self.calibration], np.float32)
        return {f"{kind}_weights": self.weights, f"{kind}_unseen": self.unseen, f"{kind}_calibration": calibration}

    def margin(self, found: Array, visible: Array) -> F64:
        """Return the SVM's output f (P,) for `found` and `visible` as of `describe`."""
        flat = found.reshape(len(found), -1)
        seen = np.einsum("pd,d->p", flat, self.weights.ravel())
        hidden = np.einsum("pd,d->p", ~visible.reshape(len(found), -1), self.unseen.ravel())
        return np.asarray(seen + hidden + self.bias, np.float64)

    def log_probability(self, margin: Array) -> F64:
        """Return the logarithm (P,) of Eq. 21 for SVM outputs `margin` (P,)."""
        a, b = self.calibration
        return np.asarray(-np.logaddexp(0.0, a * margin + b))


@dataclass(frozen=True, slots=True, eq=False)
class ContourLikelihood:
    """Likelihood of part contours by the edges of an image; `filters` by kind of part, kinds without one score 0."""

    filters: Mapping[str, ContourFilter]

    def log_likelihood(self, features: ImageFeatures, part: str, contours: Array, scale: Array | float) -> F64:
        """Return the logarithm (P,) of Eq. 21 for `contours` (P, K, 2) px of `part` at `scale` px/m, (P,) or one.

        Contours that are not finite, or whose scale is not positive, get -inf; all others get 0 if the part's kind was
        not learned.
        """
        contours = np.asarray(contours, np.float64)
        scale = np.broadcast_to(np.asarray(scale, np.float64), len(contours))
        usable = np.isfinite(contours).all(axis=(1, 2)) & np.isfinite(scale) & (scale > 0)
        result = np.where(usable, 0.0, -np.inf)
        kind = part_kind(part)
        if kind in self.filters and usable.any():
            known = self.filters[kind]
            found = describe(features, order_as_right(part, contours[usable]), known.weights.shape[1], scale[usable])
            result[usable] = known.log_probability(known.margin(*found))
        return result
