# SPDX-License-Identifier: Apache-2.0
"""Tells, while a recording is replayed, that the calibration is wrong: people of another size, a camera that is off."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.multiview.association.height import measure_height
from flowing_puppet_ros.multiview.association.people_tracker import PersonInSpace
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
_MAX_VIEW_M = 0.04  # median distance of a camera's joints from those in space, at their depth
_MIN_JOINTS = 50  # of a camera, for that
_PER_METRE = {"mm": 1000.0, "cm": 100.0}


class RigCheck:
    """Asks once whether the people of the first sets are as people are; `names` are those of the joints."""

    def __init__(self, names: Sequence[str]) -> None:
        """Start before the first set."""
        self._names = tuple(names)
        self._joints: list[F64] = []
        self._distances: dict[str, list[F64]] = {}
        self._instants: list[People] = []
        self._sets = 0

    def add(self, cameras: Mapping[str, Camera], people: People, found: Sequence[PersonInSpace]) -> str:
        """Take the people in the images of a set, and those in space.

        Returns what is wrong in one sentence, once; "" if nothing is or nobody can tell.
        """
        if self._sets >= _SETS or sum(bool(group) for group in people.values()) < 2:
            return ""
        self._sets += 1
        self._instants.append(people)
        for person in found:
            self._joints.append(person.joints)
            for name, view in person.seen.items():
                pixels, depth = cameras[name].project(person.joints)
                distance = np.linalg.norm(pixels - view.joints, axis=1) * depth / cameras[name].focal
                self._distances.setdefault(name, []).append(distance[np.isfinite(distance)])
        if self._sets < _SETS:
            return ""
        told = self._judge_size(cameras) or self._judge_cameras()
        self._joints, self._instants, self._distances = [], [], {}
        return told

    def _judge_size(self, cameras: Mapping[str, Camera]) -> str:
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
        if not np.isfinite(tall) or MIN_HEIGHT_M / _TOLERANCE < tall < MAX_HEIGHT_M * _TOLERANCE:
            return ""
        units = [unit for unit, count in _PER_METRE.items() if MIN_HEIGHT_M < tall / count < MAX_HEIGHT_M]
        remedy = f"the poses seem to be in {units[0]}" if units else "its unit is wrong"
        return (
            f"with this calibration people would be {tall:.3g} m tall: {remedy}, and metres are expected; import it "
            "again with --unit, or with --person-height"
        )

    def _judge_cameras(self) -> str:
        distances = {name: np.concatenate(each) for name, each in self._distances.items()}
        medians = {name: float(np.median(each)) for name, each in distances.items() if len(each) >= _MIN_JOINTS}
        off = [
            f"half of the joints in {name} lie more than {100 * median:.0f} cm from where the other cameras have them"
            for name, median in medians.items()
            if median > _MAX_VIEW_M
        ]
        if self._joints:
            showing = Counter(name for people in self._instants for name, group in people.items() if group)
            off += [
                f"{name} shows nobody whom the others show"
                for name, sets in showing.items()
                if sets > _SETS / 2 and name not in self._distances
            ]
        if not off:
            return ""
        return f"{'; '.join(off)}: refine the calibration and the clocks with flowing-puppet calibrate"
