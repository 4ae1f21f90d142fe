# SPDX-License-Identifier: Apache-2.0
"""The units that a scan may be in, by the size of an adult; a fit decides between several."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.scans.names import UNITS
from flowing_puppet_ros.body.scans.scan import Scan

METRIC_UNITS = ("m", "cm", "mm")
GUESS = "guess"
"""The unit of scans whose size was changed: metres per unit follow from an adult's size."""
MIN_ADULT_AREA_M2, MEAN_ADULT_AREA_M2, MAX_ADULT_AREA_M2 = 1.2, 1.8, 3.0
"""Surface area of an adult's body."""
MIN_PERSON_EXTENT_M, MIN_ADULT_EXTENT_M, MAX_ADULT_EXTENT_M = 0.6, 1.3, 2.6
"""Longest side of the box around a child or a crouching adult, and around an adult who stands or lies."""
ADULT_EXTENTS_M = (1.7, 1.25)
"""Longest sides, standing and crouching, to which a scan of another size is scaled."""
SAME_LOG_SCALE = 0.2
"""Logarithm of the ratio of two scales below which a body fits equally well in both."""
MAX_NORMALISED_ERROR = 0.002
"""Relative departure from 1 or 2 of the longest side, or from 1 of the radius, of scans that were normalised."""
MIN_SCENE_EXTENT_M, MAX_SCENE_EXTENT_M, MAX_LEFT_FLOOR_EXTENT_M = 0.6, 200.0, 12.0
"""Longest side of the cloud of a scene, and of one person's with the floor left in."""


@dataclass(frozen=True, slots=True)
class ScanUnit:
    """A unit that a scan may be in.

    Attributes:
        name: one of `UNITS`, or `GUESS`.
        metres: metres per unit.
        fitted: metres per unit in which a body is fitted: more than `metres` for a child, who is fitted as an adult.
    """

    name: str
    metres: float
    fitted: float

    @classmethod
    def named(cls, name: str) -> ScanUnit:
        """Return one of `UNITS`."""
        return cls(name, UNITS[name], UNITS[name])

    @classmethod
    def guessed(cls, metres: float) -> ScanUnit:
        """Return the unit of a scan that is to have an adult's size."""
        return cls(GUESS, metres, metres)


def propose_units(scan: Scan) -> list[ScanUnit]:
    """Propose the units that a scan of one person may be in, the likelier first.

    A closed surface tells most, because its area does not depend on the pose: the unit that makes it 1.2 to 3 square
    metres, otherwise the factor that makes it 1.8. A cloud's longest side must be 1.3 to 2.6 m, if an adult stands or
    lies; otherwise it is a child, an adult who crouches, or was scaled.
    """
    longest = float(np.ptp(scan.points, axis=0).max())
    if scan.area is not None and is_closed(scan):
        for name, metres in UNITS.items():
            if MIN_ADULT_AREA_M2 <= scan.area * metres**2 <= MAX_ADULT_AREA_M2:
                return [ScanUnit.named(name)]
        return [ScanUnit.guessed(float(np.sqrt(MEAN_ADULT_AREA_M2 / scan.area)))]
    adult = [name for name, metres in UNITS.items() if MIN_ADULT_EXTENT_M <= longest * metres <= MAX_ADULT_EXTENT_M]
    smaller = [name for name, metres in UNITS.items() if MIN_PERSON_EXTENT_M <= longest * metres < MIN_ADULT_EXTENT_M]
    guessed = [ScanUnit.guessed(extent / longest) for extent in ADULT_EXTENTS_M]
    if is_normalised(scan.points):
        return [*guessed, *map(ScanUnit.named, adult)]
    if adult:
        return [ScanUnit.named(name) for name in (*adult, *smaller) if name in adult or name in METRIC_UNITS]
    named = [ScanUnit.named(name) for name in smaller]
    return [*named, *(unit for unit in guessed if not any(_are_alike(unit, other) for other in named))]


def _are_alike(first: ScanUnit, second: ScanUnit) -> bool:
    return abs(np.log(first.fitted / second.fitted)) < SAME_LOG_SCALE


def propose_named_unit(points: np.ndarray, name: str) -> list[ScanUnit]:
    """Return the unit that the user named and, for a person smaller than an adult, the same with a child's scale."""
    longest = float(np.ptp(points, axis=0).max())
    unit = ScanUnit.named(name)
    if not MIN_PERSON_EXTENT_M / 2 <= longest * unit.metres < MIN_ADULT_EXTENT_M:
        return [unit]
    return [unit, ScanUnit(name, unit.metres, ADULT_EXTENTS_M[0] / longest)]


def propose_sensor_units(points: np.ndarray) -> list[ScanUnit]:
    """Propose the unit of a cloud (N, 3) seen from its own frame's origin: sensors measure in m, cm or mm."""
    longest = float(np.ptp(points, axis=0).max())
    return [
        ScanUnit.named(name)
        for name in METRIC_UNITS
        if MIN_PERSON_EXTENT_M <= longest * UNITS[name] <= MAX_ADULT_EXTENT_M
    ]


def has_size_of_person(points: np.ndarray) -> bool:
    """Return whether the longest side of a cloud (N, 3) is a person's in m, cm or mm."""
    return bool(propose_sensor_units(points))


def is_normalised(points: np.ndarray) -> bool:
    """Return whether points (N, 3) were scaled to a unit cube, a cube from -1 to 1, or a unit sphere."""
    low, high = points.min(axis=0), points.max(axis=0)
    longest, radius = float((high - low).max()), float(np.linalg.norm(points, axis=1).max())
    centred = bool(np.all(low < 0) and np.all(high > 0))
    return (
        abs(longest - 1) < MAX_NORMALISED_ERROR
        or (centred and abs(longest - 2) < 2 * MAX_NORMALISED_ERROR)
        or (centred and abs(radius - 1) < MAX_NORMALISED_ERROR)
    )


def is_closed(scan: Scan) -> bool:
    """Return whether nearly all edges have two faces."""
    if scan.faces is None:
        return False
    edges = np.sort(np.concatenate([scan.faces[:, [0, 1]], scan.faces[:, [1, 2]], scan.faces[:, [2, 0]]]), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    return bool(np.mean(count == 2) > 0.97)
