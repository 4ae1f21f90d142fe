# SPDX-License-Identifier: Apache-2.0
"""People in images: found, missed, reported twice, badly posed, or reported where the truth has nobody.

A person is found if the median error of the annotated joints is under a share of the larger side of the box around
them. A puppet counts for one person only.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.evaluate.joints import ARM_JOINTS
from flowing_puppet_ros.evaluate.precision import ScoredImage
from flowing_puppet_ros.evaluate.similarity import (
    SAME_SHARE,
    Joints2D,
    can_compare,
    measure_extent,
    measure_shares,
    measure_similarity,
    stand_on_anybody,
)

MAX_SHARE = 0.08
"""Of the true person's extent: who is found has a smaller median error."""

type Unmatched = Literal["wrong", "unknown"]
"""What people are who stand on nobody in the truth: wrong, or unknown because not everybody is annotated."""


def add_unmatched_argument(parser: argparse.ArgumentParser) -> None:
    """Add the flag `--unmatched`."""
    parser.add_argument(
        "--unmatched",
        choices=("wrong", "unknown"),
        default="wrong",
        help="what found people are where the truth has nobody: wrong, or unknown because the truth does not have"
        " everybody [%(default)s]",
    )


@dataclass(slots=True)
class PeopleTally:
    """Counts over images.

    Attributes:
        people: true ones that can be compared.
        found: of these.
        twice: further puppets on somebody who is found.
        astray: puppets on somebody whom none shows well enough.
        elsewhere: puppets on nobody.
        shares: median error of each found person, as a share of their extent.
        arms: error of each annotated arm joint of those found, as such a share.
    """

    people: int = 0
    found: int = 0
    twice: int = 0
    astray: int = 0
    elsewhere: int = 0
    shares: list[float] = field(default_factory=list)
    arms: list[float] = field(default_factory=list)

    def add(self, found: Sequence[Joints2D], true: Sequence[Joints2D], names: Sequence[str]) -> None:
        """Count one image, comparing the joints among `names`."""
        comparable = [person for person in true if can_compare(person, names)]
        self.people += len(comparable)
        shares = measure_shares(found, comparable, names)
        pairs = _pair(shares)
        self.found += len(pairs)
        for row, column in pairs.items():
            self.shares.append(float(shares[row, column]))
            self.arms += _list_arm_shares(found[row], comparable[column], names)
        taken = set(pairs.values())
        for row in set(range(len(found))) - pairs.keys():
            near = np.flatnonzero(shares[row] <= SAME_SHARE)
            if not len(near):
                self.elsewhere += 1
            elif near[shares[row, near].argmin()] in taken:
                self.twice += 1
            else:
                self.astray += 1

    def list_counts(self) -> dict[str, float]:
        """Return the counts by name."""
        return {
            "people": float(self.people),
            "people found": float(self.found),
            "people missed": float(self.people - self.found),
            "puppets twice on a person": float(self.twice),
            "puppets badly on a person": float(self.astray),
            "puppets on nobody annotated": float(self.elsewhere),
        }

    def summarise(self, unmatched: Unmatched) -> dict[str, float]:
        """Return counts and percentages by name; puppets on nobody lower the precision unless they are unknown."""
        reported = self.found + self.twice + self.astray + (self.elsewhere if unmatched == "wrong" else 0)
        near = np.array(self.arms) < MAX_SHARE
        arms = f"arm joints of those found within {100 * MAX_SHARE:g} % of extent, %"
        return self.list_counts() | {
            "precision of people, %": 100 * self.found / reported if reported else float("nan"),
            "error of those found, median, % of extent": 100 * float(np.median(self.shares or [np.nan])),
            arms: 100 * float(near.mean()) if len(near) else float("nan"),
        }


def rate_people(
    found: Sequence[Joints2D], score: Array, true: Sequence[Joints2D], names: Sequence[str], unmatched: Unmatched
) -> ScoredImage:
    """Return the OKS of the people in an image over the joints `names`, and their `score` (F,).

    True people with none of these joints are left out, and found ones who stand on nobody if these are unknown.
    """
    similarity = measure_similarity(found, true, names)
    similarity = similarity[:, [can_compare(person, names) for person in true]]
    if unmatched == "unknown":
        chosen = stand_on_anybody(found, true, names)
        return ScoredImage(similarity[chosen], score[chosen])
    return ScoredImage(similarity, score)


def _pair(shares: Array) -> dict[int, int]:
    """Pair puppets with the people they show (F, T): as many as possible, then with the smallest errors."""
    good = shares < MAX_SHARE
    rows, columns = linear_sum_assignment(np.where(good, shares, 1.0 + len(shares) * MAX_SHARE))
    return {int(row): int(column) for row, column in zip(rows, columns, strict=True) if good[row, column]}


def _list_arm_shares(found: Joints2D, true: Joints2D, names: Sequence[str]) -> list[float]:
    arms = [name for name in names if name in true and name.split("_")[-1] in ARM_JOINTS]
    extent = measure_extent(true)
    return [float(np.linalg.norm(found[name] - true[name])) / extent if name in found else np.inf for name in arms]
