# SPDX-License-Identifier: Apache-2.0
"""A scene that several sensors saw at one time, in the frame that they have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.arrays import F64, I64, Bools
from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.body.scene.rig_agreement import find_seen_through
from flowing_puppet_ros.body.scene.scene_cloud import SceneCloud
from flowing_puppet_ros.evidence.cloud.sensor_rig import SensorRig

MAX_PERSON_DISTANCE_M = 0.024
"""Two-way distance up to which a body shows that what several sensors saw is a person: of drawn people it is 1.1 to 1.6
cm, of 350 points 2.3 cm; of boxes of a person's size 2.7 to 6 cm."""


@dataclass(frozen=True, slots=True, eq=False)
class RigScene(SceneCloud):
    """The clouds of several sensors as one, z up; people are found in it as in a cloud from all sides.

    Attributes:
        parts: what each sensor saw, whose points follow one another in `points`.
    """

    parts: tuple[SceneCloud, ...] = ()

    @classmethod
    def merge(cls, parts: Sequence[SceneCloud], stamp: int) -> RigScene:
        """Join the clouds of one or more sensors, which are in one frame, without what another sensor saw through."""
        parts = [part.take(~free) for part, free in zip(parts, find_seen_through(parts), strict=True)]
        points = np.concatenate([part.points for part in parts])
        viewpoint = np.mean([part.viewpoint for part in parts], axis=0)
        return cls(points, None, stamp, viewpoint=viewpoint, parts=tuple(parts))

    @property
    def is_merged(self) -> bool:
        """Whether several sensors saw it."""
        return True

    @property
    def owner(self) -> I64:
        """Return the number (N,) of the sensor that saw each point."""
        return np.repeat(np.arange(len(self.parts)), [len(part.points) for part in self.parts])

    @property
    def distance(self) -> F64:
        """Distance (N,) m of each point from the sensor that saw it."""
        return np.concatenate([part.distance for part in self.parts])

    def take(self, rows: Bools) -> RigScene:
        """Return the part of the scene whose points are `rows` (N,)."""
        ends = np.cumsum([len(part.points) for part in self.parts])[:-1]
        parts = tuple(part.take(own) for part, own in zip(self.parts, np.split(rows, ends), strict=True))
        return replace(self, points=self.points[rows], parts=parts)

    def with_fields(self, people: Sequence[PersonCloud]) -> list[PersonCloud]:
        """Return people with the sensors around them and what each can know of each person.

        A fit has to show that they are people, see `shows_person`: furniture may have a person's size.
        """
        owner, starts = self.owner, np.cumsum([0, *(len(part.points) for part in self.parts)])
        images = [part.draw_image() if len(part.points) else None for part in self.parts]
        viewpoints = np.stack([part.viewpoint for part in self.parts])
        found = []
        for person in people:
            rows = np.arange(len(self.points)) if person.rows is None else person.rows
            fields = tuple(
                None if image is None else image.make_field(rows[owner[rows] == number] - starts[number])
                for number, image in enumerate(images)
            )
            rig = SensorRig(viewpoints, fields, owner[rows])
            found.append(replace(person, normals=None, viewpoint=self.viewpoint, field=rig, proven=False))
        return found


def shows_person(person: PersonCloud, fit: BodyFit) -> bool:
    """Return whether a body shows that the points are a person's: a reliable one, or one close to several sensors'."""
    near = isinstance(person.field, SensorRig) and fit.two_way_distance < MAX_PERSON_DISTANCE_M
    return fit.reliable or near
