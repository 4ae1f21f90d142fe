# SPDX-License-Identifier: Apache-2.0
"""A cloud of a scene with its sensor, and the box in which people are searched for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import F64, Bools
from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.evidence.cloud.depth_smoothing import smooth_depth
from flowing_puppet_ros.evidence.cloud.range_image import RangeImage
from flowing_puppet_ros.settings import Settings, setting

_MAX_COORDINATE = 10_000.0


def _bound(default: float, text: str) -> Any:
    return setting(default, text, unit="m", low=-_MAX_COORDINATE, high=_MAX_COORDINATE, advanced=True)


@dataclass(frozen=True)
class RegionSettings(Settings):
    """The box, in the cloud's own frame, in which people are searched for."""

    min_x: float = _bound(-_MAX_COORDINATE, "minimum x of the points that are used")
    max_x: float = _bound(_MAX_COORDINATE, "maximum x of the points that are used")
    min_y: float = _bound(-_MAX_COORDINATE, "minimum y of the points that are used")
    max_y: float = _bound(_MAX_COORDINATE, "maximum y of the points that are used")
    min_z: float = _bound(-_MAX_COORDINATE, "minimum z of the points that are used")
    max_z: float = _bound(_MAX_COORDINATE, "maximum z of the points that are used")


def crop_to_region(points: F64, region: RegionSettings) -> Bools:
    """Return which (N,) of the points (N, 3) m in the cloud's frame lie in the region."""
    low = np.array([region.min_x, region.min_y, region.min_z])
    high = np.array([region.max_x, region.max_y, region.max_z])
    inside = np.ones(len(points), dtype=bool)
    for column, least, most in zip(points.T, low, high, strict=True):  # faster than rows of three
        inside &= (column >= least) & (column <= most)
    return inside


@dataclass(frozen=True, eq=False)
class SceneCloud:
    """A cloud with z up.

    Attributes:
        points: (N, 3) metres, in a frame that is the same for all clouds of a stream.
        normals: (N, 3) or None.
        stamp: nanoseconds.
        single_view: whether it is known to be seen from one side.
        image: its range image where it is organised, whose pixels are those of the points.
        viewpoint: (3,) metres, where the sensor is.
        to_sensor: (3, 3), from this frame to the sensor's own with z up, however the sensor is tilted.
        sensor_height: metres, of the sensor over the floor where that is known; else the points have to show it.
    """

    points: F64
    normals: F64 | None
    stamp: int
    single_view: bool = False
    image: RangeImage | None = None
    viewpoint: F64 = field(default_factory=lambda: np.zeros(3))
    to_sensor: F64 = field(default_factory=lambda: np.eye(3))
    sensor_height: float | None = None

    @property
    def is_merged(self) -> bool:
        """Whether several sensors saw it."""
        return False

    @property
    def whole(self) -> PersonCloud:
        """All of the cloud as one person."""
        return PersonCloud(self.points, self.normals, self.stamp)

    def take(self, rows: Bools) -> SceneCloud:
        """Return the part of the cloud whose points are `rows` (N,)."""
        normals = None if self.normals is None else self.normals[rows]
        return replace(self, points=self.points[rows], normals=normals, image=self.image and self.image.take(rows))

    @cached_property
    def distance(self) -> F64:
        """Distance (N,) m of the points from the sensor."""
        x, y, z = (self.points - self.viewpoint).T  # faster than rows of three
        return np.asarray(np.sqrt(x * x + y * y + z * z))

    def draw_image(self) -> RangeImage:
        """Return its range image; a scan without order is drawn into one as its sensor is held."""
        if self.image is not None:
            return self.image
        if np.array_equal(self.to_sensor, np.eye(3)):  # held level, which saves a third of the time
            return RangeImage.of_scan(self.points, self.viewpoint)
        drawn = RangeImage.of_scan((self.points - self.viewpoint) @ self.to_sensor.T, np.zeros(3))
        return drawn.turn(self.to_sensor.T).move(self.viewpoint)

    def with_image(self) -> SceneCloud:
        """Return the same cloud with its range image."""
        return replace(self, image=self.draw_image())

    def with_fields(self, people: Sequence[PersonCloud]) -> list[PersonCloud]:
        """Return people seen from the viewpoint with what the sensor can know of each.

        A scan without order is drawn into an image for that, unless the person is all of it: its own extent says
        nothing about the sensor's. The points of a noisy depth image are averaged.
        """
        image = self.image
        if image is None and any(person.rows is not None for person in people):
            image = self.draw_image()
        if image is None:
            return list(people)
        made = []
        for person in people:
            rows = slice(None) if person.rows is None else person.rows
            if self.image is None and person.rows is None:
                made.append(person)
                continue
            points = person.points
            if self.image is not None and person.normals is None:
                points = smooth_depth(image, self.points, rows)
            made.append(replace(person, points=points, field=image.make_field(rows)))
        return made
