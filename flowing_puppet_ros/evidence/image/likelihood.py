# SPDX-License-Identifier: Apache-2.0
"""The image likelihood of a puppet's parts: contour and colour terms with learned weights (Eq. 20)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64, U8, Array
from flowing_puppet_ros.evidence.image.colour import ColourImage, SkinColour, torso_map
from flowing_puppet_ros.evidence.image.contour import ContourFilter, ContourLikelihood, kind_of
from flowing_puppet_ros.evidence.image.features import ImageFeatures
from flowing_puppet_ros.evidence.image.outline import grown
from flowing_puppet_ros.evidence.image.region import RegionMap, ratio
from flowing_puppet_ros.model import weights
from flowing_puppet_ros.model.ds.joints import part_tree
from flowing_puppet_ros.model.ds.render import render_labels

TERMS = ("contour", "skin", "skin_around", "hand", "torso", "torso_around")
"""Terms of a part: log phi_contour (Eq. 21); mean log ratio of skin, and of the torso's colours, inside it; how much
that exceeds a band around the part; and the mean log ratio of skin where the hand is."""

TERMS_OF = {
    "torso": TERMS[:1],
    "head": TERMS[:3],
    "upper_arm": ("contour", "skin", "skin_around", "torso", "torso_around"),
    "lower_arm": ("contour", "skin", "skin_around", "hand"),
}
"""Which terms each kind of part has; legs have none until contours of legs are learned."""

BAND = 0.04
"""Width, in metres, of the band around a part that its colours are set against."""

HAND, AROUND = 0.03, 0.12
"""Standard deviations, in metres, of the spots in which hands are looked for, and of their surroundings."""

REACH = 0.85
"""Farthest that a hand is from the middle of the head, in metres."""

_COARSEST = 4.0  # px: standard deviation beyond which a map is blurred at lower resolution
_HAND_SHARE = 5  # of the lower arm's points, from the finger tips back on either side, one in so many is the hand's


@dataclass(frozen=True, slots=True, eq=False)
class PartLikelihood:
    """What is learned of how a person's parts look: `terms[kind]` are the weights of TERMS_OF[kind]."""

    parts: int
    contour: ContourLikelihood
    skin: SkinColour
    terms: Mapping[str, Array]

    @classmethod
    def load(cls, parts: int = 10) -> Self:
        """Load what ships with the package; InputError when there is none for a puppet of so many parts."""
        return cls.from_arrays(parts, weights.load("likelihood", f"{parts}"))

    @classmethod
    def from_arrays(cls, parts: int, arrays: Mapping[str, Array]) -> Self:
        """Build from the arrays that `to_arrays` gave."""
        kinds = [key.removesuffix("_terms") for key in arrays if key.endswith("_terms")]
        filters = {kind: ContourFilter.from_arrays(kind, arrays) for kind in kinds}
        terms = {kind: np.asarray(arrays[f"{kind}_terms"], np.float64) for kind in kinds}
        return cls(parts, ContourLikelihood(filters), SkinColour(np.asarray(arrays["skin"], np.float64)), terms)

    def to_arrays(self) -> dict[str, Array]:
        """The learned numbers as float32 arrays by name."""
        arrays: dict[str, Array] = {"skin": np.asarray(self.skin.log_ratio, np.float32)}
        for kind, weight in self.terms.items():
            arrays |= self.contour.filters[kind].to_arrays(kind) | {f"{kind}_terms": np.asarray(weight, np.float32)}
        return arrays

    def scene(self, image: U8) -> ImageEvidence:
        """Make ready to ask about an RGB (H,W,3) or grey (H,W) uint8 image in which no torso is known yet."""
        features, colours = ImageFeatures.of(image), ColourImage.of(image)
        return ImageEvidence(self, part_tree(self.parts).names, features, colours, self.skin.map(colours), None, None)


@dataclass(frozen=True, slots=True, eq=False)
class ImageEvidence:
    """One image, and what is known of the colours of the person in it. Scenes of one image share its features."""

    likelihood: PartLikelihood
    names: tuple[str, ...]
    features: ImageFeatures
    colours: ColourImage
    skin: RegionMap
    torso: RegionMap | None
    head: Array | None

    def with_torso(self, torso: Array, head: Array) -> ImageEvidence:
        """Take the colours of sleeves and skin from the person with the contours `torso` and `head` (K,2) px."""
        skin = self.likelihood.skin.map(self.colours, head)
        return replace(self, skin=skin, torso=torso_map(self.colours, torso, head), head=np.array(head))

    def log_likelihood(self, part: int, contours: Array, scale: Array | float) -> F64:
        """Weighted sum (P,) of the terms of Eq. 20 for contours (P,K,2) px of part index `part`; higher is likelier.

        `scale` is px/m, (P,) or one. What lies outside the image says nothing for or against; contours that are not
        finite get -inf; parts that were not learned 0. Torso colours say nothing until they are known.
        """
        terms = self.terms(part, contours, scale)
        usable = np.isfinite(terms).all(axis=1)
        weight = self.likelihood.terms.get(kind_of(self.names[part]), np.zeros(1))
        return np.where(usable, np.einsum("pt,t->p", np.where(usable[:, None], terms, 0.0), weight), -np.inf)

    def contour_and_colour(self, part: int, contours: Array, scale: Array | float) -> tuple[F64, F64]:
        """The weighted terms of `log_likelihood` in two sums, each (P,): contour, and all that is of colour."""
        weighted = self.terms(part, contours, scale) * self.likelihood.terms.get(kind_of(self.names[part]), np.zeros(1))
        usable = np.isfinite(weighted).all(axis=1)
        return np.where(usable, weighted[:, 0], -np.inf), np.where(usable, weighted[:, 1:].sum(axis=1), 0.0)

    def terms(self, part: int, contours: Array, scale: Array | float) -> F64:
        """The terms (P,T) that TERMS_OF names for the part, before they are weighted; only the contour's for others."""
        name = self.names[part]
        scale = np.broadcast_to(np.asarray(scale, np.float64), len(contours))
        columns = {"contour": self.likelihood.contour.log_likelihood(self.features, name, contours, scale)}
        wanted = TERMS_OF.get(kind_of(name), TERMS[:1])
        if "skin" in wanted:
            columns["skin"], columns["skin_around"] = _inside_and_around(self.skin, contours, scale)
        if "hand" in wanted:
            columns["hand"] = self.skin.mean(hand_of(contours))
        if "torso" in wanted:
            nothing = (np.zeros(len(contours)),) * 2
            known = nothing if self.torso is None else _inside_and_around(self.torso, contours, scale)
            columns["torso"], columns["torso_around"] = known
        return np.stack([columns[term] for term in wanted], axis=1)

    def hand_map(self, scale: float) -> F64:
        """Where hands may be (H,W), summing to 1: spots of a hand's size that are skin, more than what is around.

        `scale` in px/m. When the head is known, only around it within REACH and not on it. Even where no skin is seen.
        """
        spots, around = (_smooth(self.skin.values, size * scale) for size in (HAND, AROUND))
        likely = np.maximum(np.exp(2.0 * spots - around) - 1.0, 0.0)
        height, width = likely.shape
        if self.head is not None and np.isfinite(self.head).all():
            x, y = self.head.mean(axis=0)
            likely[np.hypot(np.arange(width) - x, np.arange(height)[:, None] - y) > REACH * scale] = 0.0
            likely[render_labels([self.head], [0], likely.shape) > 0] = 0.0
        total = likely.sum()
        return np.asarray(likely / total if total > 0.0 else np.full(likely.shape, 1.0 / likely.size))


def _smooth(values: Array, deviation: float) -> F64:
    """Gaussian blur of a map (H,W); the larger the standard deviation in px, the coarser the map that is blurred."""
    shrink = max(1.0, deviation / _COARSEST)
    size = [max(1, round(side / shrink)) for side in values.shape[::-1]]
    small = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), max(deviation / shrink, 0.5), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.resize(small, values.shape[::-1], interpolation=cv2.INTER_LINEAR)).reshape(values.shape)


def hand_of(contours: Array) -> Array:
    """The points (P,n,2) of the hand of lower-arm contours (P,K,2) that include it."""
    count = contours.shape[1]
    return contours[:, count // 2 - count // _HAND_SHARE : count // 2 + count // _HAND_SHARE + 1]


def _inside_and_around(colour: RegionMap, contours: Array, scale: Array) -> tuple[Array, Array]:
    """Mean (P,) of a map inside contours, and how much it exceeds the mean of the band around them."""
    total, area = colour.sums(contours)
    outer_total, outer_area = colour.sums(grown(contours, BAND * scale))
    inside, around = ratio(total, area), ratio(outer_total - total, np.maximum(outer_area - area, 0.0))
    return inside, np.where(outer_area > area, inside - around, 0.0)
