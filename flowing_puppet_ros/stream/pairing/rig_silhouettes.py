# SPDX-License-Identifier: Apache-2.0
"""The silhouettes that belong to what depth sensors saw: paired by stamp, brought into the frame of the tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from flowing_puppet_ros.arrays import Bools
from flowing_puppet_ros.body.scene.scene_cloud import SceneCloud
from flowing_puppet_ros.body.track.multi_body_tracker import MultiBodyTrackerSettings
from flowing_puppet_ros.body.track.tracked_body import TrackedBody
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.fusion.people_fitter import FusionSettings, PeopleFitter
from flowing_puppet_ros.fusion.rig.rig_people import RigPeople
from flowing_puppet_ros.fusion.rig.silhouette_person import SilhouettePerson
from flowing_puppet_ros.multiview.silhouette_fit import SilhouetteFitterSettings
from flowing_puppet_ros.reporting import Report
from flowing_puppet_ros.stream.messages.bodies.silhouettes import decode_views
from flowing_puppet_ros.stream.messages.geometry import FrameTree, stamp_ns
from flowing_puppet_ros.stream.messages.puppets import decode_body_joints
from flowing_puppet_ros.stream.pairing.depth_rig import DepthRigSettings
from flowing_puppet_ros.stream.pairing.time_synchronizer import BACKWARD_JUMP_NS
from flowing_puppet_ros.stream.sensor_places import SensorPlace
from flowing_puppet_ros.units import NANOSECONDS

MAX_INSTANTS = 60
"""Instants whose silhouettes are kept."""
MAX_APART_NS = NANOSECONDS
"""From a moment to the nearest silhouettes, within which they are of these cameras but not of this time."""
MAX_MISSED = 10
"""Moments in a row that lie between silhouettes; then these are never of the time of the depth."""
MAX_SAME_PERSON_M = 0.5
"""Between the mean joints of a body from depth alone and of the silhouettes of the same person a moment later."""


class RigFitSettings(Protocol):
    """The settings of a body fitter that fits of silhouettes and depth take."""

    @property
    def rig(self) -> DepthRigSettings:
        """`slop`: silhouettes belong to a moment that is no farther from them."""
        ...

    @property
    def fusion(self) -> FusionSettings:
        """`wait`: how long moments wait for silhouettes."""
        ...

    @property
    def silhouettes(self) -> SilhouetteFitterSettings:
        """Of the fits."""
        ...

    @property
    def tracker(self) -> MultiBodyTrackerSettings:
        """Of the tracks."""
        ...


class RigSilhouettes:
    """Keeps silhouettes until what the depth sensors saw at their time is there, and fits bodies to both."""

    def __init__(self, people: PeopleFitter, settings: RigFitSettings, frames: FrameTree, report: Report) -> None:
        """Fit with `people`; `frames` take what comes on /tf and /tf_static."""
        tracks = settings.tracker
        self._people = RigPeople(people, settings.silhouettes, tracks, tracks.hold, report)
        self._frames, self._report = frames, report
        self._slop_ns, self._wait_ns = (round(1e9 * each) for each in (settings.rig.slop, settings.fusion.wait))
        self.reset()

    def reset(self) -> None:
        """Forget everybody and what waits."""
        self.reset_people()
        self._instants: dict[int, dict[str, Any]] = {}
        self._missed = 0

    def reset_people(self) -> None:
        """Forget everybody."""
        self._people.reset()
        self._others: list[TrackedBody] = []
        self._names: dict[str, str] = {}

    def add(self, message: Any) -> None:
        """Take a SilhouetteSet."""
        stamp = stamp_ns(message)
        if self._instants and stamp < max(self._instants) - BACKWARD_JUMP_NS:
            self._instants = {}
        self._instants.setdefault(stamp, {})[message.person.id] = message
        while len(self._instants) > MAX_INSTANTS:
            del self._instants[min(self._instants)]

    def is_awaited(self, stamp: int, first: int, last: int) -> bool:
        """Return whether silhouettes of a moment at a stamp may still come.

        `first` is the stamp of the first moment of all and `last` that of the last one that waits, nanoseconds.
        """
        newest = max(self._instants, default=None)
        if newest is None or newest < stamp - self._slop_ns:
            return last - (first if newest is None else newest) <= self._wait_ns
        return not self._is_complete(newest) and newest <= stamp + self._slop_ns

    def _is_complete(self, stamp: int) -> bool:
        sets = self._instants[stamp]
        return all(set(message.people) <= set(sets) for message in sets.values())

    def fit(self, scene: SceneCloud, stamp: int, frame: str, place: SensorPlace) -> tuple[list[TrackedBody], Bools]:
        """Return the bodies of everybody whom silhouettes show or have shown, and which points (N,) are theirs.

        Args:
            scene: what the sensors saw, in the frame of the tracks.
            stamp: nanoseconds, by the clock of the messages.
            frame: the fixed frame.
            place: that of the fixed frame in the one of the tracks.
        """
        people = [person for message in self._take(stamp) if (person := self._decode(message, stamp, frame, place))]
        for person in people:
            self._names.setdefault(person.id, self._find_name(person))
        people = [replace(person, id=self._names[person.id]) for person in people]
        return self._people.step(scene, people, scene.stamp)

    def add_others(self, others: Sequence[TrackedBody], occluded: Sequence[str]) -> tuple[list[TrackedBody], list[str]]:
        """Take note of the bodies of this moment that are from depth alone, in the frame of the tracks.

        Whose silhouettes come later keeps the id. `occluded` are the ids of those who are out of the depth's sight.
        Returns those of other people than silhouettes show, and the ids of all who had a body and have none now.
        """
        shown = self._people.shown_ids
        self._others = [body for body in others if body.id not in shown]
        return self._others, sorted({*self._people.occluded_ids, *occluded} - shown)

    def _find_name(self, person: SilhouettePerson) -> str:
        """Return the id of the body from depth alone that is where a new person is, or else the person's own."""
        places = np.array([joint[:3] for joint in person.joints.values() if np.isfinite(joint).all()])
        if not len(places):
            return person.id
        taken = set(self._names.values())
        near = {
            body.id: float(np.linalg.norm(body.fit.joints.mean(axis=0) - places.mean(axis=0)))
            for body in self._others
            if body.id not in taken
        }
        nearest = min(near, key=lambda each: near[each], default="")
        return nearest if nearest and near[nearest] < MAX_SAME_PERSON_M else person.id

    def _take(self, stamp: int) -> list[Any]:
        """Return the sets of the instant nearest to a stamp; those before the next moment are dropped."""
        nearest = min(self._instants, key=lambda each: (abs(each - stamp), each), default=None)
        if nearest is None:
            return []
        apart = abs(nearest - stamp)
        found = list(self._instants[nearest].values()) if apart <= self._slop_ns else []
        is_between = self._slop_ns < apart <= MAX_APART_NS
        self._missed = self._missed + 1 if is_between else 0
        self._report.counters["moments without silhouettes"] += is_between
        if self._missed == MAX_MISSED:
            self._report.warn(
                f"the silhouettes nearest to what depth sensors saw are {apart / NANOSECONDS:.3f} s from it, beyond "
                f"the rig.slop of {self._slop_ns / NANOSECONDS:g} s: such moments have bodies from depth alone"
            )
        for old in [each for each in self._instants if each <= stamp - self._slop_ns]:
            del self._instants[old]
        return sorted(found, key=lambda message: str(message.person.id))

    def _decode(self, message: Any, stamp: int, frame: str, place: SensorPlace) -> SilhouettePerson | None:
        """Return the person of a set in the frame of the tracks, None where it cannot be used."""
        own = message.header.frame_id.lstrip("/")
        pose = self._frames.lookup_pose(own, frame, stamp)
        if pose is None:
            why = self._frames.describe_missing(own, frame, stamp)
            self._report.count_unusable(InputError(f"silhouettes are left out: {why}"))
            return None
        views = {}
        for name, made in decode_views(message).items():
            if isinstance(made, InputError):
                self._report.count_unusable(made)
            else:
                views[name] = made
        person = SilhouettePerson(message.person.id or "a1", views, decode_body_joints(message.person))
        return person.move(place.rotation @ pose[1], place.rotation @ pose[0] + place.translation)
