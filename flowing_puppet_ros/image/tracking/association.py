# SPDX-License-Identifier: Apache-2.0
"""Which detection belongs to which tracked person."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.image.tracking.appearance import TorsoAppearance, hellinger_distance
from flowing_puppet_ros.image.tracking.track import Track

type Detection = tuple[F64, F64]  # joints (J, 2) px with NaN unknown, confidence (J,)

APPEARANCE = 0.6  # m; joints this far off count as much as clothes that have nothing in common
SAME, OTHERS = 0.45, 0.15  # unlikeness of the clothes that a person is known by, and how much more that of others is
AGAIN = 3.0  # times the distance to which somebody is looked for whom another person hid


def joint_distance(person: Track, detection: Detection) -> float:
    """Median distance in metres over the joints that both know; infinite when they share fewer than three."""
    both = np.isfinite(detection[0]).all(axis=1) & ~person.unknown
    if np.count_nonzero(both) < 3:
        return np.inf
    apart = detection[0][both] - person.mean[both]
    return float(np.median(np.hypot(apart[:, 0], apart[:, 1]))) / person.scale


def associate(
    people: Sequence[Track],
    detections: Sequence[Detection],
    limit: float,
    appearances: Sequence[TorsoAppearance | None] | None = None,
) -> tuple[dict[int, int], list[int]]:
    """Match people and detections one to one: the joints are near, none beyond `limit` metres, and the clothes alike.

    `worn` is what each detected person wears. Who was matched with none, and has met somebody who may have hidden and
    dragged them along, is found again at AGAIN times the distance by clothes that no other person wears.

    Returns {person: detection} and the detections that are nobody's: a second detection of a matched person
    (within `limit`) is not among them.
    """
    if not people or not detections:
        return {}, list(range(len(detections)))
    apart = np.array([[joint_distance(person, detection) for detection in detections] for person in people])
    cost = np.minimum(apart, 1e3 * limit)
    strange = _appearance_cost(people, appearances, apart.shape)
    rows, columns = linear_sum_assignment(cost + APPEARANCE * strange)
    matched = {int(row): int(column) for row, column in zip(rows, columns, strict=True) if apart[row, column] <= limit}
    matched |= _reidentify(people, apart, strange, matched, AGAIN * limit)
    taken = set(matched.values())
    free = [k for k in range(len(detections)) if k not in taken and not (apart[list(matched), k] <= limit).any()]
    return matched, free


def _appearance_cost(
    people: Sequence[Track], worn: Sequence[TorsoAppearance | None] | None, shape: tuple[int, int]
) -> F64:
    """How unlike (people, detections) the clothes are; 0.5 where they are not known."""
    strange = np.full(shape, 0.5)
    for row, person in enumerate(people):
        for column, clothes in enumerate(worn or ()):
            if person.appearance is not None and clothes is not None:
                strange[row, column] = hellinger_distance(person.appearance, clothes.colours)
    return strange


def _reidentify(
    people: Sequence[Track], apart: F64, strange: F64, matched: dict[int, int], limit: float
) -> dict[int, int]:
    """People who have met others, and the detections that are theirs by the clothes, the likest first."""
    rows = [k for k, person in enumerate(people) if k not in matched and person.overlapped]
    columns = [k for k in range(apart.shape[1]) if k not in matched.values()]
    found: dict[int, int] = {}
    for row, column in sorted(((r, c) for r in rows for c in columns), key=lambda pair: float(strange[pair])):
        others = min((strange[k, column] for k in range(len(people)) if k != row), default=1.0)
        known = strange[row, column] <= min(SAME, others - OTHERS)
        if known and apart[row, column] <= limit and row not in found and column not in found.values():
            found[row] = column
    return found
