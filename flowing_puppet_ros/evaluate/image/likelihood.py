# SPDX-License-Identifier: Apache-2.0
"""Discrimination of the image likelihood: ranks of right limbs among perturbed ones, with and without each term.

Every part is scored alone: the right contour is that of the puppet on the annotated joints, the wrong ones are rotated,
shifted and stretched until their points are off by 5 cm on average. The colours of torso and face are taken from the
right torso and head, as if these had been found.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.arrays import F64, Array
from flowing_puppet_ros.evidence.image.contour import LEVELS, ContourFilter, describe, order_as_right, part_kind
from flowing_puppet_ros.evidence.image.likelihood import TERMS_OF, ImageEvidence, PartLikelihood
from flowing_puppet_ros.evidence.image.steered_hog import SIDES
from flowing_puppet_ros.learn.likelihood.samples import ContourPerturbation, PosedPerson, perturb_contours
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

CUES = {"contour": ("contour",), "skin": ("skin", "skin_around", "hand"), "torso colour": ("torso", "torso_around")}
"""Terms that are left out together."""

SIDE_NAMES = ("inside", "on", "outside")


@dataclass(frozen=True, slots=True, eq=False)
class Ranks:
    """Ranks `places` (n,) of right contours among `wrong` wrong ones, from 0; a tie counts as half a rank."""

    places: F64
    wrong: int

    def summarise(self) -> tuple[float, float, float, float]:
        """Return the share of wrong ones beaten, the median rank from 1, and the shares of ranks first and within 5."""
        beaten = 1.0 - self.places.mean() / self.wrong
        first, five = np.mean(self.places < 1.0), np.mean(self.places < 5.0)
        return float(beaten), float(np.median(self.places) + 1.0), float(first), float(five)


def rank_limbs(
    model: DeformableStructures, likelihood: PartLikelihood, people: Iterator[PosedPerson], wrong: int, seed: int
) -> dict[str, dict[str, Ranks]]:
    """Rank limbs by kind of part and variant ("all", "only skin", "without skin", "contour, only inside", ...)."""
    rng = np.random.default_rng(seed)
    places: dict[str, dict[str, list[float]]] = {kind: {} for kind in likelihood.terms}
    for posed in people:
        scene = likelihood.prepare(posed.image).with_torso(*posed.puppet.contours[:2])
        for part, name in enumerate(model.tree.names):
            kind = part_kind(name)
            if kind not in places or not posed.shows(model, part):
                continue
            moved = perturb_contours(model, posed.puppet, part, wrong, ContourPerturbation(), rng)
            contours = np.concatenate([posed.puppet.contours[part][None], moved])
            scores = _score_terms(scene, part, contours, posed.puppet.scale)
            scores |= _score_contour(scene, part, contours, posed.puppet.scale)
            for variant, score in scores.items():
                better = np.sum(score[1:] > score[0]) + 0.5 * np.sum(score[1:] == score[0])
                places[kind].setdefault(variant, []).append(float(better))
    return {
        kind: {variant: Ranks(np.array(found), wrong) for variant, found in variants.items()}
        for kind, variants in places.items()
    }


def _score_terms(scene: ImageEvidence, part: int, contours: Array, scale: float) -> dict[str, Array]:
    """Return weighted sums (P,) of all terms, of each cue alone, and without each cue if two others remain."""
    kind = part_kind(scene.names[part])
    weighted = scene.terms(part, contours, scale) * scene.likelihood.terms[kind]
    cues = {cue: np.isin(TERMS_OF[kind], terms) for cue, terms in CUES.items() if set(terms) & set(TERMS_OF[kind])}
    scores = {"all": weighted.sum(axis=1)}
    for cue, own in cues.items():
        if len(cues) > 1:
            scores[f"only {cue}"] = weighted[:, own].sum(axis=1)
        if len(cues) > 2:
            scores[f"without {cue}"] = weighted[:, ~own].sum(axis=1)
    return scores


def _score_contour(scene: ImageEvidence, part: int, contours: Array, scale: float) -> dict[str, Array]:
    """Return margins (P,) of the contour filter with only, and without, the descriptors of a side or pyramid level."""
    name = scene.names[part]
    known = scene.likelihood.contour.filters[part_kind(name)]
    ordered = order_as_right(name, contours)
    found, visible = describe(scene.features, ordered, known.weights.shape[1], np.full(len(contours), scale))
    scores = {}
    for label, kept in _make_masks():
        margin = _mask_filter(known, kept).margin(found, visible)
        scores[f"contour, only {label}"] = margin
        scores[f"contour, without {label}"] = known.margin(found, visible) - margin
    return scores


def _make_masks() -> Iterator[tuple[str, Array]]:
    for side, label in enumerate(SIDE_NAMES):
        yield label, np.broadcast_to(np.arange(SIDES) == side, (LEVELS, 1, SIDES))
    for level in range(LEVELS):
        yield f"level {level + 1}", np.broadcast_to((np.arange(LEVELS) == level)[:, None, None], (LEVELS, 1, SIDES))


def _mask_filter(known: ContourFilter, kept: Array) -> ContourFilter:
    """Return the filter with the weights of all descriptors but `kept` (LEVELS, 1, SIDES) set to 0."""
    weights = (known.weights * kept[..., None]).astype(np.float32)
    return replace(known, weights=weights, unseen=(known.unseen * kept).astype(np.float32), bias=0.0)


def format_ranks(ranks: Mapping[str, Mapping[str, Ranks]]) -> str:
    """Format the ranks as a Markdown table."""
    lines = [
        "| part | terms | n | wrong ones beaten | median rank | first | in first 5 |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind, variants in ranks.items():
        for variant, found in variants.items():
            beaten, median, first, five = found.summarise()
            lines.append(
                f"| {kind} | {variant} | {len(found.places)} | {100 * beaten:.1f} % | {median:g} of {found.wrong + 1} "
                f"| {100 * first:.0f} % | {100 * five:.0f} % |"
            )
    return "\n".join(lines)
