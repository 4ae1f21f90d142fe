# SPDX-License-Identifier: Apache-2.0
"""What several sensors around a person can know together: what one of them cannot see another may."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.arrays import F64, I64, Bools
from flowing_puppet_ros.evidence.cloud.sensor_field import SensorField


@dataclass(frozen=True, slots=True, eq=False)
class SensorRig:
    """The sensors that saw the points of one cloud.

    Attributes:
        viewpoints: (S, 3) metres, where each sensor is.
        fields: what each can know of the person, None where it is taken to see everything.
        owner: (N,) number of the sensor that saw each point of the cloud.
    """

    viewpoints: F64
    fields: tuple[SensorField | None, ...]
    owner: I64

    def own(self, owner: I64) -> SensorRig:
        """Return the same sensors for another cloud, whose points the sensors `owner` (N,) saw."""
        return replace(self, owner=owner)

    def doubt_blanks(self, points: F64) -> SensorRig:
        """Return the same with `SensorField.doubt_blanks` of each sensor and its own of the `points` (N, 3) m."""
        fields = [
            None if field is None else field.doubt_blanks(points[self.owner == number])
            for number, field in enumerate(self.fields)
        ]
        return replace(self, fields=tuple(fields))

    def find_unknown(self, points: F64) -> Bools:
        """Return which (N,) of the places `points` (N, 3) m no sensor knows anything about."""
        unknown = np.ones(len(points), dtype=bool)
        for field in self.fields:
            unknown &= False if field is None else field.find_unknown(points)
        return unknown

    def find_facing(self, vertices: F64, normals: F64) -> Bools:
        """Return which vertices (V, 3) m with outward `normals` (V, 3) face a sensor that has them in its field."""
        facing = np.zeros(len(vertices), dtype=bool)
        for viewpoint, field in zip(self.viewpoints, self.fields, strict=True):
            turned = ((viewpoint - vertices) * normals).sum(axis=1) > 0
            facing |= turned if field is None else turned & ~field.find_unknown(vertices)
        return facing
