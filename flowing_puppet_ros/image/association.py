# SPDX-License-Identifier: Apache-2.0
"""Which detection belongs to which tracked person."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from flowing_puppet_ros.image.people import Person

type Floats = NDArray[np.float64]
type Detection = tuple[Floats, Floats]  # joints (J, 2) px with NaN unknown, confidence (J,)


def joint_distance(person: Person, detection: Detection) -> float:
    """Median distance in metres over the joints that both know; infinite when they share fewer than three."""
    both = np.isfinite(detection[0]).all(axis=1) & ~person.unknown
    if np.count_nonzero(both) < 3:
        return np.inf
    apart = detection[0][both] - person.mean[both]
    return float(np.median(np.hypot(apart[:, 0], apart[:, 1]))) / person.scale


def associate(
    people: Sequence[Person], detections: Sequence[Detection], limit: float
) -> tuple[dict[int, int], list[int]]:
    """Match people and detections one to one with the least summed joint distance, none beyond `limit` metres.

    Returns {person: detection} and the detections that are nobody's: a second detection of a matched person
    (within `limit`) is not among them.
    """
    if not people or not detections:
        return {}, list(range(len(detections)))
    cost = np.array([[joint_distance(person, detection) for detection in detections] for person in people])
    rows, columns = linear_sum_assignment(np.minimum(cost, 1e3 * limit))
    matched = {int(row): int(column) for row, column in zip(rows, columns, strict=True) if cost[row, column] <= limit}
    taken = set(matched.values())
    free = [k for k in range(len(detections)) if k not in taken and not (cost[list(matched), k] <= limit).any()]
    return matched, free
