# SPDX-License-Identifier: Apache-2.0
"""Contour term of the image likelihood: steered HOG descriptors, a linear SVM a part, calibrated (Eqs. 20 to 22)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from flowing_puppet_ros.arrays import F32, F64, Array, Bools
from flowing_puppet_ros.evidence.image.features import CHANNELS, ImageFeatures
from flowing_puppet_ros.evidence.image.outline import mirrored_order
from flowing_puppet_ros.evidence.image.steered_hog import SIDES, descriptors
from flowing_puppet_ros.model.tree import mirrored_name

CELL_METRES = 0.03
"""Side of a cell of the finest level (Eq. 22; the thesis says 0.02 of the image's height at scale 1)."""

LEVELS = 3
"""Levels of the pyramid; cells of the next are twice as wide."""

PLACES = {"torso": 40, "head": 20, "upper_arm": 14, "lower_arm": 20}
"""Places along the contour of each kind of part; with three descriptors each, as many as in the thesis."""


def kind_of(part: str) -> str:
    """Kind of a part, for which left and right share what is learned: "left_upper_arm" gives "upper_arm"."""
    return part.removeprefix("right_").removeprefix("left_")


def on_right(part: str, contours: Array) -> Array:
    """Contours (...,K,2) of a part with their points in the order of the part on the person's right."""
    return mirrored_order(contours) if mirrored_name(part) != part and part.startswith("left_") else contours


def describe(features: ImageFeatures, contours: Array, places: int, scale: Array) -> tuple[F32, Bools]:
    """Descriptors (P,LEVELS,places,SIDES,CHANNELS) of contours (P,K,2) px at `scale` (P,) px/m, and which are seen.

    The places are spread evenly over the contour's points. At every level the descriptors inside and outside are one
    cell away from the contour.
    """
    chosen = np.arange(places) * contours.shape[1] // places
    found = np.zeros((len(contours), LEVELS, places, SIDES, CHANNELS), np.float32)
    visible = np.zeros(found.shape[:-1], np.bool_)
    for step in range(LEVELS):
        cell = CELL_METRES * 2**step * np.asarray(scale, np.float64)
        numbers = features.levels_of(cell)
        for number in np.unique(numbers):
            here = numbers == number
            level = features.level(int(number))
            found[here, step], visible[here, step] = descriptors(level, contours[here], chosen, cell[here])
    return found, visible


@dataclass(frozen=True, slots=True, eq=False)
class ContourFilter:
    """What is learned for one kind of part.

    weights (LEVELS,places,SIDES,CHANNELS) and bias: the linear SVM. unseen (LEVELS,places,SIDES): what a descriptor
    outside the image contributes, its mean over right and wrong examples. calibration: a_i and b_i of Eq. 21.
    """

    weights: F32
    unseen: F32
    bias: float
    calibration: tuple[float, float]

    @classmethod
    def from_arrays(cls, kind: str, arrays: Mapping[str, Array]) -> Self:
        """Take the arrays of one kind of part from a likelihood file."""
        bias, a, b = (float(value) for value in arrays[f"{kind}_calibration"])
        return cls(arrays[f"{kind}_weights"], arrays[f"{kind}_unseen"], bias, (a, b))

    def to_arrays(self, kind: str) -> dict[str, Array]:
        """The arrays that `from_arrays` reads."""
        calibration = np.array([self.bias, *self.calibration], np.float32)
        return {f"{kind}_weights": self.weights, f"{kind}_unseen": self.unseen, f"{kind}_calibration": calibration}

    def margin(self, found: Array, visible: Array) -> F64:
        """The SVM's output f (P,) for descriptors as `describe` gives them."""
        flat = found.reshape(len(found), -1)
        seen = np.einsum("pd,d->p", flat, self.weights.ravel())
        hidden = np.einsum("pd,d->p", ~visible.reshape(len(found), -1), self.unseen.ravel())
        return np.asarray(seen + hidden + self.bias, np.float64)

    def log_probability(self, margin: Array) -> F64:
        """Logarithm (P,) of Eq. 21."""
        a, b = self.calibration
        return np.asarray(-np.logaddexp(0.0, a * margin + b))


@dataclass(frozen=True, slots=True, eq=False)
class ContourLikelihood:
    """How well part contours lie on the edges of an image. `filters` by kind of part; kinds without one say nothing."""

    filters: Mapping[str, ContourFilter]

    def log_likelihood(self, features: ImageFeatures, part: str, contours: Array, scale: Array | float) -> F64:
        """Logarithm (P,) of Eq. 21 for contours (P,K,2) px of the part called `part` at `scale` ((P,) or one) px/m.

        Contours that are not finite, or whose scale is not positive, get -inf; all others are 0 where the part's kind
        was not learned.
        """
        contours = np.asarray(contours, np.float64)
        scale = np.broadcast_to(np.asarray(scale, np.float64), len(contours))
        usable = np.isfinite(contours).all(axis=(1, 2)) & np.isfinite(scale) & (scale > 0)
        result = np.where(usable, 0.0, -np.inf)
        kind = kind_of(part)
        if kind in self.filters and usable.any():
            known = self.filters[kind]
            found = describe(features, on_right(part, contours[usable]), known.weights.shape[1], scale[usable])
            result[usable] = known.log_probability(known.margin(*found))
        return result
