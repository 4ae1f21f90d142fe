# SPDX-License-Identifier: Apache-2.0
"""The people of successive clouds: where they are looked for, from where they are seen, and who they are."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64, Bools
from flowing_puppet_ros.body.cloud.coverage import is_single_view
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter, Progress
from flowing_puppet_ros.body.segmentation.people import PersonCloud, SegmentationSettings, segment_people
from flowing_puppet_ros.body.segmentation.planes import PlaneCache
from flowing_puppet_ros.body.track.multi_body_tracker import MultiBodyTracker, MultiBodyTrackerSettings
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.settings import Settings, setting

_MAX_COORDINATE = 10_000.0
MAX_HEIGHT = 2.6
"""Metres: a cloud that is no wider is a person, when nobody can be told from their surroundings in it."""
ONE = "b1"
"""Id of the person when all of a cloud is one person."""


@dataclass(frozen=True)
class RegionSettings(Settings):
    """The box, in the cloud's own frame, in which people are looked for."""

    region_x_min: float = setting(
        -_MAX_COORDINATE, "least x of points that are used", unit="m", low=-_MAX_COORDINATE, high=_MAX_COORDINATE
    )
    region_x_max: float = setting(
        _MAX_COORDINATE, "largest x of points that are used", unit="m", low=-_MAX_COORDINATE, high=_MAX_COORDINATE
    )
    region_y_min: float = setting(
        -_MAX_COORDINATE, "least y of points that are used", unit="m", low=-_MAX_COORDINATE, high=_MAX_COORDINATE
    )
    region_y_max: float = setting(
        _MAX_COORDINATE, "largest y of points that are used", unit="m", low=-_MAX_COORDINATE, high=_MAX_COORDINATE
    )
    region_z_min: float = setting(
        -_MAX_COORDINATE, "least z of points that are used", unit="m", low=-_MAX_COORDINATE, high=_MAX_COORDINATE
    )
    region_z_max: float = setting(
        _MAX_COORDINATE, "largest z of points that are used", unit="m", low=-_MAX_COORDINATE, high=_MAX_COORDINATE
    )


@dataclass(frozen=True)
class SceneSettings(MultiBodyTrackerSettings, SegmentationSettings, RegionSettings):
    """Where the people are looked for, how they are seen, and whether they are followed."""

    view: str = setting("auto", "people are seen from all sides (full) or from one sensor at the frame's origin"
                                " (single); auto: as their first points look",
                        choices=("auto", "full", "single"))  # fmt: skip
    track: bool = setting(True, "follow people through the clouds that come without initial joints")
    scene: bool = setting(True, "find the people among floor, walls and furniture in clouds that come without initial"
                                " joints; off: all of a cloud is one person")  # fmt: skip


def crop_to_region(points: F64, region: RegionSettings) -> Bools:
    """Which of the points (N,3) in metres in the cloud's frame lie in the region (N,)."""
    low = np.array([region.region_x_min, region.region_y_min, region.region_z_min])
    high = np.array([region.region_x_max, region.region_y_max, region.region_z_max])
    return np.asarray(((points >= low) & (points <= high)).all(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class OrientedCloud:
    """A cloud: points (N,3) and normals (N,3) or None in metres, z up after `turn` (3,3); the stamp in nanoseconds.

    `single` says that it is known to be seen from one side, from the origin of its frame.
    """

    points: F64
    normals: F64 | None
    turn: F64
    stamp: int
    single: bool = False


class SceneTracker:
    """Finds the people in clouds and fits a body to each: tracked, or every cloud for itself."""

    def __init__(self, fitter: BodyFitter, settings: SceneSettings) -> None:
        """Fit with `fitter`."""
        self._fitter = fitter
        self._settings = settings
        self._crowd = MultiBodyTracker(fitter, settings, fitter.settings.seed)
        self._single: bool | None = None
        self._planes = PlaneCache()

    def warm_up(self) -> None:
        """Do beforehand what the first cloud would wait for."""
        self._fitter.warm_up()
        standing = self._fitter.model.vertices(self._fitter.model.rest_state())
        segment_people(standing, None, self._settings)

    def reset(self) -> None:
        """Forget everybody."""
        self._crowd.reset()
        self._single = None
        self._planes = PlaneCache()

    def drain(self) -> tuple[Counter[str], list[InputError]]:
        """What was counted, and why people could not be used, since the last call."""
        found = self._crowd.counters, self._crowd.errors
        self._crowd.counters, self._crowd.errors = Counter(), []
        return found

    def step(
        self, view: OrientedCloud, seed: int, background: Executor | None = None
    ) -> tuple[list[tuple[str, BodyFit]], list[str]]:
        """Return (id, fit) of everybody in the next cloud, and the ids of those who are out of sight for now.

        `background` is what `Crowd` says of it. InputError when the cloud cannot be one of people.
        """
        settings = self._settings
        self._check(view)
        if not settings.scene:
            whole = [PersonCloud(view.points, view.normals, np.arange(len(view.points)), 1.0)]
            viewpoint = self._viewpoint(view, whole)
            if not settings.track:
                return [(ONE, self._full_fit(whole[0], viewpoint, seed))], []
            return self._crowd.step_one(whole[0], view.stamp, viewpoint, seed, background), []
        known = self._crowd.bodies(view.stamp) if settings.track else ()
        people = segment_people(view.points, view.normals, settings, self._sensor(view), known, self._planes)
        viewpoint = self._viewpoint(view, people)
        if settings.track:
            return self._crowd.step(people, view.stamp, viewpoint, seed, background), self._crowd.occluded_ids
        named = self._crowd.associate_only(people, view.stamp)
        return [(identity, self._full_fit(person, viewpoint, seed)) for identity, person in named], []

    def fit_once(self, view: OrientedCloud, seed: int, progress: Progress | None = None) -> list[tuple[str, BodyFit]]:
        """Return (id, fit) of everybody in a cloud that belongs to no stream; ids count from b1.

        Where nobody can be told from surroundings, a cloud of a person's size is the person.
        """
        people: list[PersonCloud] = []
        if self._settings.scene:
            people = segment_people(view.points, view.normals, self._settings, self._sensor(view))
        extent = np.ptp(view.points, axis=0).max(initial=0.0) if len(view.points) else 0.0
        if not people and (not self._settings.scene or extent <= MAX_HEIGHT):
            people = [PersonCloud(view.points, view.normals, np.arange(len(view.points)), 1.0)]
        if not people:
            raise InputError(f"there is nobody in the cloud of {len(view.points)} points; turn scene off to fit it all")
        viewpoint = self._viewpoint(view, people, remember=False)
        return [
            (f"b{number}", self._full_fit(person, viewpoint, seed, progress))
            for number, person in enumerate(people, start=1)
        ]

    def _check(self, view: OrientedCloud) -> None:
        if not len(view.points):
            raise InputError("the cloud has no finite point in the region of interest")
        distance = np.linalg.norm(view.points, axis=1)
        if self._sensor(view) is not None and distance.min() > self._settings.reach:
            raise InputError(
                f"the nearest point of the cloud is {distance.min():.3g} m from the origin of its frame, beyond the"
                f" reach of {self._settings.reach:g} m; check the unit, or widen reach"
            )

    def _full_fit(
        self, person: PersonCloud, viewpoint: F64 | None, seed: int, progress: Progress | None = None
    ) -> BodyFit:
        return self._fitter.fit(person.points, person.normals, viewpoint=viewpoint, seed=seed, progress=progress)

    def _sensor(self, view: OrientedCloud) -> F64 | None:
        """Where the sensor stands when people are cut out: at the origin, unless they are seen all round."""
        full = self._settings.view == "full" or (self._settings.view == "auto" and self._single is False)
        return None if full and not view.single else np.zeros(3)

    def _viewpoint(self, view: OrientedCloud, people: list[PersonCloud], remember: bool = True) -> F64 | None:
        """Where the sensor stands for the fits: what is known or set, else what the first people look like."""
        if view.single:
            return np.zeros(3)
        single = {"single": True, "full": False}.get(self._settings.view, self._single)
        if single is None and people:
            single = is_single_view(people[0].points)
            if remember:
                self._single = single
        return np.zeros(3) if single else None
