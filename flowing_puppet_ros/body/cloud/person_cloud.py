# SPDX-License-Identifier: Apache-2.0
"""The cloud of one person, as segmentation hands it to the trackers and these to the fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64, I64
from flowing_puppet_ros.evidence.cloud.sensor_field import SensorField
from flowing_puppet_ros.evidence.cloud.sensor_rig import SensorRig


@dataclass(frozen=True, slots=True, eq=False)
class PersonCloud:
    """One person's part of a cloud.

    Attributes:
        points: (N, 3) metres, z up.
        normals: (N, 3) outward unit normals, or None where they are not known.
        stamp: nanoseconds.
        viewpoint: (3,) metres, position of the sensor when the cloud shows one side only, else None.
        rows: (N,) indices into the scene's points, ascending; None when the cloud is all of them.
        score: 0 to 1, how much size, shape and position are a person's.
        owner: index of the known body in these points, None for a new person.
        floor: metres, z of the floor under the person, None where it is not known.
        proven: whether it is known to be a person; else a reliable fit has to show it.
        field: what the sensor at the viewpoint can know of the person, or several sensors; None where it is taken to
            see everything.
    """

    points: F64
    normals: F64 | None = None
    stamp: int = 0
    viewpoint: F64 | None = None
    rows: I64 | None = None
    score: float = 1.0
    owner: int | None = None
    floor: float | None = None
    proven: bool = True
    field: SensorField | SensorRig | None = None

    @property
    def middle(self) -> F64:
        """Median (3,) of the points."""
        return np.asarray(np.median(self.points, axis=0))
