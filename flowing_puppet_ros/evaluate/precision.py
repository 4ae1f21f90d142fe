# SPDX-License-Identifier: Apache-2.0
"""Average precision and recall of people over many images, as COCO computes them from similarities and scores.

COCO's own program needs its files, areas and ids for what is a page of NumPy here; `test_precision.py` has its figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import Array, Bools

MIN_SIMILARITIES = np.linspace(0.5, 0.95, 10)
MAX_PEOPLE = 20
"""People of an image that count, the best first."""
RECALLS = np.linspace(0, 1, 101)  # at which the precision is read


@dataclass(frozen=True, slots=True, eq=False)
class ScoredImage:
    """One image: the OKS `similarity` (F, T) of found and true people, and the `score` (F,) of the found ones."""

    similarity: Array
    score: Array


def measure_precision(images: Sequence[ScoredImage]) -> dict[str, float]:
    """Return OKS AP, AP50, AP75 and AR in percent; all NaN if there is no true person."""
    true = sum(image.similarity.shape[1] for image in images)
    names = ("OKS AP, %", "OKS AP50, %", "OKS AP75, %", "OKS AR, %")
    if not true:
        return dict.fromkeys(names, float("nan"))
    ranked = [np.argsort(-image.score, kind="stable")[:MAX_PEOPLE] for image in images]
    order = np.argsort(
        -np.concatenate([one.score[rank] for one, rank in zip(images, ranked, strict=True)]), kind="stable"
    )
    precision, recall = np.zeros(len(MIN_SIMILARITIES)), np.zeros(len(MIN_SIMILARITIES))
    for k, least in enumerate(MIN_SIMILARITIES):
        hits = [_match(one.similarity[rank], least) for one, rank in zip(images, ranked, strict=True)]
        precision[k], recall[k] = _integrate(np.concatenate(hits)[order], true)
    values = (precision.mean(), precision[0], precision[5], recall.mean())
    return {name: 100 * float(value) for name, value in zip(names, values, strict=True)}


def _match(similarity: Array, least: float) -> Bools:
    """Give each found person (F, T), the best first, the most similar true one that is left; return who got one."""
    left = similarity.copy()
    hit = np.zeros(len(left), bool)
    for row in range(len(left) if left.size else 0):
        # Of equally similar ones COCO takes the last.
        best = left.shape[1] - 1 - int(left[row, ::-1].argmax())
        if left[row, best] >= least:
            hit[row] = True
            left[:, best] = -1.0
    return hit


def _integrate(hit: Bools, true: int) -> tuple[float, float]:
    """Return the mean precision over RECALLS and the largest recall, from hits (n,) in the order of their scores."""
    if not len(hit):
        return 0.0, 0.0
    right = np.cumsum(hit)
    recall, precision = right / true, right / np.arange(1, len(hit) + 1)
    envelope = np.append(np.maximum.accumulate(precision[::-1])[::-1], 0.0)
    return float(envelope[np.searchsorted(recall, RECALLS)].mean()), float(recall[-1])
