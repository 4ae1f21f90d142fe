# SPDX-License-Identifier: Apache-2.0
"""Image likelihood of a puppet's parts: contour and colour terms with learned weights (Eq. 20)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64, U8, Array
from flowing_puppet_ros.evidence.image.colour import ColourImage, SkinColour, torso_map
from flowing_puppet_ros.evidence.image.contour import ContourFilter, ContourLikelihood, part_kind
from flowing_puppet_ros.evidence.image.features import ImageFeatures
from flowing_puppet_ros.evidence.image.outline import grow
from flowing_puppet_ros.evidence.image.region import RegionMap, ratio
from flowing_puppet_ros.model import weights
from flowing_puppet_ros.model.ds.joints import part_tree
from flowing_puppet_ros.model.ds.render import render_labels

TERMS = ("contour", "skin", "skin_around", "hand", "torso", "torso_around")
"""Terms of a part: log phi_contour (Eq. 21); mean log ratio of skin, and of the torso's colours, inside it; by how much
each exceeds that of a band around the part; and the mean log ratio of skin at the hand."""

TERMS_OF = {
    "torso": TERMS[:1],
    "head": TERMS[:3],
    "upper_arm": ("contour", "skin", "skin_around", "torso", "torso_around"),
    "lower_arm": ("contour", "skin", "skin_around", "hand"),
}
"""Terms of each kind of part; legs have none until contours of legs are learned."""

BAND_WIDTH_M = 0.04
"""Width of the band around a part with which its colours are compared."""

HAND_SPREAD_M, SURROUND_SPREAD_M = 0.03, 0.12
"""Standard deviations of the spots in which hands are searched for, and of their surroundings."""

MAX_HAND_DISTANCE_M = 0.85
"""Maximum distance of a hand from the middle of the head."""

_MAX_BLUR_PX = 4.0  # standard deviation beyond which a map is blurred at lower resolution
_HAND_SHARE = 5  # one in so many of the lower arm's points, on either side of the fingertips, belongs to the hand


@dataclass(frozen=True, slots=True, eq=False)
class PartLikelihood:
    """Learned appearance of a person's parts: `terms[kind]` are the weights of TERMS_OF[kind]."""

    parts: int
    contour: ContourLikelihood
    skin: SkinColour
    terms: Mapping[str, Array]

    @classmethod
    def load(cls, parts: int = 10) -> Self:
        """Load the shipped likelihood; InputError if there is none for a puppet of so many parts."""
        return cls.from_arrays(parts, weights.load("likelihood", f"{parts}"))

    @classmethod
    def from_arrays(cls, parts: int, arrays: Mapping[str, Array]) -> Self:
        """Build from the arrays that `to_arrays` returns."""
        kinds = [key.removesuffix("_terms") for key in arrays if key.endswith("_terms")]
        filters = {kind: ContourFilter.from_arrays(kind, arrays) for kind in kinds}
        terms = {kind: np.asarray(arrays[f"{kind}_terms"], np.float64) for kind in kinds}
        return cls(parts, ContourLikelihood(filters), SkinColour(np.asarray(arrays["skin"], np.float64)), terms)

    def to_arrays(self) -> dict[str, Array]:
        """Return what was learned as float32 arrays by name."""
        arrays: dict[str, Array] = {"skin": np.asarray(self.skin.log_ratio, np.float32)}
        for kind, weight in self.terms.items():
            arrays |= self.contour.filters[kind].to_arrays(kind) | {f"{kind}_terms": np.asarray(weight, np.float32)}
        return arrays

    def prepare(self, image: U8) -> ImageEvidence:
        """Prepare the evidence of an RGB (H, W, 3) or grey (H, W) uint8 image in which no torso is known yet."""
        features, colours = ImageFeatures.of(image), ColourImage.of(image)
        return ImageEvidence(self, part_tree(self.parts).names, features, colours, self.skin.map(colours), None, None)


@dataclass(frozen=True, slots=True, eq=False)
class ImageEvidence:
    """Evidence of one image, and the known colours of the person in it; evidence of one image shares its features."""

    likelihood: PartLikelihood
    names: tuple[str, ...]
    features: ImageFeatures
    colours: ColourImage
    skin: RegionMap
    torso: RegionMap | None
    head: Array | None

    def with_torso(self, torso: Array, head: Array) -> ImageEvidence:
        """Take the colours of sleeves and skin from the person with the contours `torso` and `head` (K, 2) px."""
        skin = self.likelihood.skin.map(self.colours, head)
        return replace(self, skin=skin, torso=torso_map(self.colours, torso, head), head=np.array(head))

    def log_likelihood(self, part: int, contours: Array, scale: Array | float) -> F64:
        """Return the weighted sum (P,) of Eq. 20's terms for `contours` (P, K, 2) px of part index `part`.

        Higher is likelier. `scale` is in px/m, (P,) or one. What lies outside the image is neutral; contours that are
        not finite get -inf, parts that were not learned 0. Torso colours are neutral until they are known.
        """
        terms = self.terms(part, contours, scale)
        usable = np.isfinite(terms).all(axis=1)
        weight = self.likelihood.terms.get(part_kind(self.names[part]), np.zeros(1))
        return np.where(usable, np.einsum("pt,t->p", np.where(usable[:, None], terms, 0.0), weight), -np.inf)

    def contour_and_colour(self, part: int, contours: Array, scale: Array | float) -> tuple[F64, F64]:
        """Return the weighted terms of `log_likelihood` as two sums, each (P,): contour, and all colour terms."""
        weighted = self.terms(part, contours, scale) * self.likelihood.terms.get(
            part_kind(self.names[part]), np.zeros(1)
        )
        usable = np.isfinite(weighted).all(axis=1)
        return np.where(usable, weighted[:, 0], -np.inf), np.where(usable, weighted[:, 1:].sum(axis=1), 0.0)

    def terms(self, part: int, contours: Array, scale: Array | float) -> F64:
        """Return the unweighted terms (P, T) that TERMS_OF names for the part; the contour's alone for other parts."""
        name = self.names[part]
        scale = np.broadcast_to(np.asarray(scale, np.float64), len(contours))
        columns = {"contour": self.likelihood.contour.log_likelihood(self.features, name, contours, scale)}
        wanted = TERMS_OF.get(part_kind(name), TERMS[:1])
        if "skin" in wanted:
            columns["skin"], columns["skin_around"] = _inside_and_around(self.skin, contours, scale)
        if "hand" in wanted:
            columns["hand"] = self.skin.mean(hand_points(contours))
        if "torso" in wanted:
            nothing = (np.zeros(len(contours)),) * 2
            known = nothing if self.torso is None else _inside_and_around(self.torso, contours, scale)
            columns["torso"], columns["torso_around"] = known
        return np.stack([columns[term] for term in wanted], axis=1)

    def hand_map(self, scale: float) -> F64:
        """Map where hands may be (H, W), summing to 1: spots of a hand's size with more skin than their surroundings.

        `scale` in px/m. If the head is known, only within MAX_HAND_DISTANCE_M of it and not on it. Uniform if no skin
        is visible.
        """
        spots, around = (_smooth(self.skin.values, size * scale) for size in (HAND_SPREAD_M, SURROUND_SPREAD_M))
        likely = np.maximum(np.exp(2.0 * spots - around) - 1.0, 0.0)
        height, width = likely.shape
        if self.head is not None and np.isfinite(self.head).all():
            x, y = self.head.mean(axis=0)
            likely[np.hypot(np.arange(width) - x, np.arange(height)[:, None] - y) > MAX_HAND_DISTANCE_M * scale] = 0.0
            likely[render_labels([self.head], [0], likely.shape) > 0] = 0.0
        total = likely.sum()
        return np.asarray(likely / total if total > 0.0 else np.full(likely.shape, 1.0 / likely.size))


def _smooth(values: Array, deviation: float) -> F64:
    """Blur a map `values` (H, W); the larger the `deviation` in px, the coarser the map that is blurred."""
    shrink = max(1.0, deviation / _MAX_BLUR_PX)
    size = [max(1, round(side / shrink)) for side in values.shape[::-1]]
    small = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), max(deviation / shrink, 0.5), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.resize(small, values.shape[::-1], interpolation=cv2.INTER_LINEAR)).reshape(values.shape)


def hand_points(contours: Array) -> Array:
    """Return the hand's points (P, n, 2) of lower-arm `contours` (P, K, 2) that include it."""
    count = contours.shape[1]
    return contours[:, count // 2 - count // _HAND_SHARE : count // 2 + count // _HAND_SHARE + 1]


def _inside_and_around(colour: RegionMap, contours: Array, scale: Array) -> tuple[Array, Array]:
    """Return the mean (P,) of a map inside contours, and how much it exceeds the mean of the band around them."""
    total, area = colour.sums(contours)
    outer_total, outer_area = colour.sums(grow(contours, BAND_WIDTH_M * scale))
    inside, around = ratio(total, area), ratio(outer_total - total, np.maximum(outer_area - area, 0.0))
    return inside, np.where(outer_area > area, inside - around, 0.0)
