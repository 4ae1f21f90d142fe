# SPDX-License-Identifier: Apache-2.0
"""Tells, while a recording is replayed, that people are no people's size: the unit of the calibration is wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.multiview.association.height import measure_height
from flowing_puppet_ros.multiview.bundle.diagnosis import (
    MAX_HEIGHT_M,
    MIN_AGREEMENT,
    MIN_HEIGHT_M,
    People,
    find_size,
)
from flowing_puppet_ros.multiview.camera import Camera

_SETS = 10  # with people in two or more cameras, after which is asked
_INSTANTS = 3  # at which other sizes are tried
_TOLERANCE = 1.15  # beyond the heights of people; measured ones are not exact
_PER_METRE = {"mm": 1000.0, "cm": 100.0}


class SizeCheck:
    """Asks once whether the people of the first sets are as tall as people are; `names` are those of the joints."""

    def __init__(self, names: Sequence[str]) -> None:
        """Start before the first set."""
        self._names = tuple(names)
        self._joints: list[F64] = []
        self._instants: list[People] = []
        self._sets = 0

    def add(self, cameras: Mapping[str, Camera], people: People, joints: Sequence[F64]) -> str:
        """Take the people in the images of a set, and the joints (J, 3) m of those in space.

        Returns what is wrong in one sentence, once; "" if nothing is or nobody can tell.
        """
        if self._sets >= _SETS or sum(bool(group) for group in people.values()) < 2:
            return ""
        self._sets += 1
        self._joints += joints
        self._instants.append(people)
        return self._judge(cameras) if self._sets == _SETS else ""

    def _judge(self, cameras: Mapping[str, Camera]) -> str:
        if self._joints:
            tall = measure_height(self._names, np.stack(self._joints))
        else:
            # Rays pass one another at distances that grow with the unit: nobody is found at the wrong one.
            factor, seen = find_size(cameras, self._names, self._instants[:: max(1, _SETS // _INSTANTS)])
            if seen.share < MIN_AGREEMENT:
                return (
                    "the cameras agree on nobody although several show people: check with flowing-puppet import "
                    "whether the calibration is that of these cameras, and whether their clocks agree"
                )
            tall = measure_height(self._names, seen.joints) / factor
        self._joints, self._instants = [], []
        if not np.isfinite(tall) or MIN_HEIGHT_M / _TOLERANCE < tall < MAX_HEIGHT_M * _TOLERANCE:
            return ""
        units = [unit for unit, count in _PER_METRE.items() if MIN_HEIGHT_M < tall / count < MAX_HEIGHT_M]
        remedy = f"the poses seem to be in {units[0]}" if units else "its unit is wrong"
        return (
            f"with this calibration people would be {tall:.3g} m tall: {remedy}, and metres are expected; import it "
            "again with --unit, or with --person-height"
        )
