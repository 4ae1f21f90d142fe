# SPDX-License-Identifier: Apache-2.0
"""Who is who over time: HOTA, IDF1, MOTA and id switches of tracks, from similarities of found and true people.

HOTA: Luiten et al., "HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking", IJCV 2021. IDF1: Ristani et
al., "Performance Measures and a Data Set for Multi-Target, Multi-Camera Tracking", ECCV workshops 2016. MOTA and
switches: Bernardin and Stiefelhagen, "Evaluating Multiple Object Tracking Performance: The CLEAR MOT Metrics", 2008.
The similarity is OKS. The library trackeval has these measures too, but brings a second OpenCV that overwrites the
headless one; `test_identity.py` has its figures.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from flowing_puppet_ros.arrays import Array

MIN_SIMILARITIES = np.arange(1, 20) / 20
"""Over these HOTA is averaged."""
MIN_SIMILARITY = 0.5  # of IDF1, MOTA and switches
IDENTITY_FIGURES = ("hota", "deta", "assa", "idf1", "mota", "id_switches")


@dataclass(frozen=True, slots=True, eq=False)
class FrameIdentities:
    """One frame: ids of T `true` and F `found` people, each once, and their `similarity` (T, F) in [0, 1]."""

    true: tuple[Hashable, ...]
    found: tuple[Hashable, ...]
    similarity: Array


@dataclass(frozen=True, slots=True, eq=False)
class IdentityCounts:
    """Counts over the frames of some clips.

    Attributes:
        true, found: people in all frames.
        matches: (19,) by MIN_SIMILARITIES.
        association: (19,) sums over the matches of how far both tracks agree, Eq. 7 of HOTA.
        same: people whose id is the one that fits their track best, by IDF1's assignment.
        kept: matches of MOTA.
        switches: matches with another id than the person's last one.
    """

    true: int
    found: int
    matches: Array
    association: Array
    same: int
    kept: int
    switches: int

    @classmethod
    def sum(cls, clips: Iterable[IdentityCounts]) -> IdentityCounts:
        """Add the counts of several clips."""
        every = [*clips]
        zero = np.zeros(len(MIN_SIMILARITIES))
        return cls(
            sum(one.true for one in every),
            sum(one.found for one in every),
            sum((one.matches for one in every), zero),
            sum((one.association for one in every), zero),
            sum(one.same for one in every),
            sum(one.kept for one in every),
            sum(one.switches for one in every),
        )

    def summarise(self) -> dict[str, float]:
        """Return HOTA, its parts DetA and AssA, IDF1 and MOTA in percent, and switches; NaN without a true person."""
        if not self.true:
            return dict.fromkeys(IDENTITY_FIGURES, float("nan"))
        detection = self.matches / (self.true + self.found - self.matches)
        association = self.association / np.maximum(self.matches, 1)
        shares = (
            np.sqrt(detection * association).mean(),
            detection.mean(),
            association.mean(),
            2 * self.same / (self.true + self.found),
            (2 * self.kept - self.found - self.switches) / self.true,
        )
        values = [round(100 * float(share), 1) for share in shares]
        return dict(zip(IDENTITY_FIGURES, [*values, float(self.switches)], strict=True))


def count_identities(frames: Sequence[FrameIdentities]) -> IdentityCounts:
    """Compare the ids of one clip's people over its frames, in order."""
    true, found = _list_ids(frame.true for frame in frames), _list_ids(frame.found for frame in frames)
    rows = [np.array([true[one] for one in frame.true], int) for frame in frames]
    columns = [np.array([found[one] for one in frame.found], int) for frame in frames]
    lengths = _count(rows, len(true))[:, None] + _count(columns, len(found))
    overlap, agreed = np.zeros((2, len(true), len(found)))
    for frame, row, column in zip(frames, rows, columns, strict=True):
        total = frame.similarity.sum(axis=0) + frame.similarity.sum(axis=1)[:, None] - frame.similarity
        overlap[np.ix_(row, column)] += np.divide(frame.similarity, total, np.zeros_like(total), where=total > 0)
        agreed[np.ix_(row, column)] += frame.similarity >= MIN_SIMILARITY
    alignment = overlap / np.maximum(lengths - overlap, 1e-12)
    together = np.zeros((len(MIN_SIMILARITIES), len(true), len(found)))
    for frame, row, column in zip(frames, rows, columns, strict=True):
        at, by = linear_sum_assignment(alignment[np.ix_(row, column)] * frame.similarity, maximize=True)
        together[:, row[at], column[by]] += frame.similarity[at, by] >= MIN_SIMILARITIES[:, None]
    kept, switches = _follow(frames, rows, columns)
    return IdentityCounts(
        sum(map(len, rows)),
        sum(map(len, columns)),
        together.sum(axis=(1, 2)),
        (together**2 / np.maximum(lengths - together, 1)).sum(axis=(1, 2)),
        int(agreed[linear_sum_assignment(agreed, maximize=True)].sum()),
        kept,
        switches,
    )


def _follow(frames: Sequence[FrameIdentities], rows: Sequence[Array], columns: Sequence[Array]) -> tuple[int, int]:
    """Count (matches, switches) of MOTA: a pair of the last frame with people stays together while similar enough."""
    kept = switches = 0
    last: dict[int, int] = {}
    before: dict[int, int] = {}
    for frame, row, column in zip(frames, rows, columns, strict=True):
        if not (len(row) and len(column)):
            continue
        worth = frame.similarity.copy()
        for k, one in enumerate(row):
            worth[k, column == before.get(int(one), -1)] += len(row) + 1.0
        at, by = linear_sum_assignment(np.where(frame.similarity >= MIN_SIMILARITY, worth, 0.0), maximize=True)
        good = frame.similarity[at, by] >= MIN_SIMILARITY
        before = {int(row[k]): int(column[m]) for k, m in zip(at[good], by[good], strict=True)}
        kept += len(before)
        switches += sum(last.get(one, other) != other for one, other in before.items())
        last |= before
    return kept, switches


def _list_ids(frames: Iterable[Iterable[Hashable]]) -> dict[Hashable, int]:
    """Give each id a number, in order of appearance."""
    return {one: number for number, one in enumerate(dict.fromkeys(one for ids in frames for one in ids))}


def _count(indices: Sequence[Array], length: int) -> Array:
    """Count how often each of `length` indices occurs."""
    return np.bincount(np.concatenate(indices) if indices else np.zeros(0, int), minlength=length)
