# SPDX-License-Identifier: Apache-2.0
"""The people whom cameras show and depth sensors around them see: whose points are whose, and a body for each.

silhouettes | points | what is done
yes         | yes    | one fit to both, started from the triangulated joints
yes         | no     | a fit to the silhouettes
no          | yes    | who is known is tracked by the points alone for as long as ids are held; nobody is new
no          | no     | the id is held for a while
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from flowing_puppet_ros.arrays import F64, I32, Bools
from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.body.fit.initialisation import body_from_joints, make_joint_targets
from flowing_puppet_ros.body.scene.scene_cloud import SceneCloud
from flowing_puppet_ros.body.segmentation.planes import PlaneCache
from flowing_puppet_ros.body.settings import BodyTrackerSettings
from flowing_puppet_ros.body.track.body_tracker import BodyTracker
from flowing_puppet_ros.body.track.tracked_body import TorsoMotion, TrackedBody
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.cloud.nearest import find_beside
from flowing_puppet_ros.fusion.joint_fit import FEW_STEPS
from flowing_puppet_ros.fusion.ownership import assign_points
from flowing_puppet_ros.fusion.people_fitter import PeopleFitter
from flowing_puppet_ros.fusion.rig.joined_fit import JoinedFitter, can_stand_alone
from flowing_puppet_ros.fusion.rig.silhouette_person import SilhouettePerson
from flowing_puppet_ros.model.sp import BodyState
from flowing_puppet_ros.multiview.silhouette_fit import SilhouetteFitterSettings
from flowing_puppet_ros.process.threads import one_blas_thread, parallel_map
from flowing_puppet_ros.reporting import Report

MAX_AGE_NS = 1_000_000_000
"""Age of a person's last body up to which it helps the next fit."""
MAX_PLANE_MOMENTS = 40
"""Moments after which floor and walls are searched again though they are still there."""
MAX_BESIDE_M = 0.15
"""From a fitted body, within which points are nobody else's: hair, clothes and pixels at edges would be new people."""
MAX_CONTRADICTIONS = 3
"""Moments in a row in which a camera's silhouette of somebody contradicts the depth, from which on it is said."""


@dataclass(slots=True, eq=False)
class _RigTrack:
    """One person: the `stamp` ns of the last body, and what tracks it when the silhouettes are missing."""

    id: str
    tracker: BodyTracker
    stamp: int = 0
    motion: TorsoMotion = field(default_factory=TorsoMotion)


@dataclass(frozen=True, slots=True, eq=False)
class _RigJob:
    """What one person's body is made of: their points, None for too few, and silhouettes, None where none came."""

    track: _RigTrack
    cloud: PersonCloud | None
    person: SilhouettePerson | None


class RigPeople:
    """Fits and tracks the people whom silhouettes show, moment by moment."""

    def __init__(
        self,
        people: PeopleFitter,
        silhouettes: SilhouetteFitterSettings,
        tracking: BodyTrackerSettings,
        hold: float,
        report: Report | None = None,
    ) -> None:
        """Fit with the parts of `people`; ids are held for `hold` seconds without a sign of the person."""
        self._people, self._model = people, people.model
        self._fitter = JoinedFitter(people.fitter, silhouettes)
        self._settings, self._hold_ns = tracking, round(1e9 * hold)
        self._report = report or Report()
        self.reset()

    def reset(self) -> None:
        """Forget everybody."""
        self._tracks: dict[str, _RigTrack] = {}
        self._planes = PlaneCache(MAX_PLANE_MOMENTS)
        self._stamp: int | None = None
        self._contradictions: dict[tuple[str, str], int] = {}
        self.shown_ids: frozenset[str] = frozenset()
        """Ids of the people who have a body in the last moment."""

    @property
    def occluded_ids(self) -> list[str]:
        """Ids of the people who have had a body and have none in the last moment."""
        return sorted(set(self._tracks) - self.shown_ids)

    def step(
        self, scene: SceneCloud, people: Sequence[SilhouettePerson], stamp: int
    ) -> tuple[list[TrackedBody], Bools]:
        """Return the bodies of everybody whom silhouettes show or have shown, and which points (N,) are theirs.

        Args:
            scene: what the depth sensors saw.
            people: at the time of the scene, in its frame.
            stamp: nanoseconds; one before the last forgets everybody.
        """
        if self._stamp is not None and stamp < self._stamp:
            self.reset()
        self._stamp = stamp
        with one_blas_thread():
            jobs, own = self._share_out(scene, people, stamp)
            fits = parallel_map(lambda job: self._fit(job, stamp), jobs, self._people.threads)
        found = []
        for job, fit in zip(jobs, fits, strict=True):
            if isinstance(fit, InputError):
                self._report.count_unusable(fit)
            elif fit is not None:
                job.track.stamp = stamp
                found.append(job.track.motion.add(job.track.id, stamp, fit))
        self.shown_ids = frozenset(body.id for body in found)
        self._report.counters["people of silhouettes and depth"] += len(found)
        for identity, track in list(self._tracks.items()):
            if stamp - track.stamp > self._hold_ns:
                del self._tracks[identity]
        for body in found:
            own |= find_beside(scene.points, body.fit.vertices, MAX_BESIDE_M)
        return found, own

    def _share_out(
        self, scene: SceneCloud, people: Sequence[SilhouettePerson], stamp: int
    ) -> tuple[list[_RigJob], Bools]:
        """Return what everybody's body is made of, and which points (N,) are anybody's."""
        clear, _ = self._people.find_clear(scene.points, self._planes)
        shown = {person.id: person for person in people}
        missing = [track for identity, track in self._tracks.items() if identity not in shown]
        bodies = [self._place(person, stamp) for person in people]
        bodies += [track.tracker.predict(stamp) for track in missing]
        owner = np.full(len(scene.points), -1, dtype=np.int32)
        owner[clear] = assign_points(scene.points[clear], [self._list_capsules(body) for body in bodies])
        tracks = [self._tracks.setdefault(person.id, self._start_track(person.id, stamp)) for person in people]
        clouds = self._cut_out(scene, owner, len(bodies), stamp)
        jobs = [
            _RigJob(track, cloud, None if person is None else self._drop_unusable(person, cloud, people))
            for track, cloud, person in zip([*tracks, *missing], clouds, [*people, *[None] * len(missing)], strict=True)
        ]
        return jobs, owner >= 0

    def _cut_out(self, scene: SceneCloud, owner: I32, count: int, stamp: int) -> list[PersonCloud | None]:
        """Return the points of each of `count` people with what the sensors know of them; None for too few points."""
        rows = [np.flatnonzero(owner == number) for number in range(count)]
        enough = [number for number in range(count) if len(rows[number]) >= self._people.min_points]
        people = [
            PersonCloud(scene.points[rows[number]], None, stamp, scene.viewpoint, rows[number]) for number in enough
        ]
        made = dict(zip(enough, scene.with_fields(people), strict=True))
        return [made.get(number) for number in range(count)]

    def _place(self, person: SilhouettePerson, stamp: int) -> BodyState | None:
        """Return roughly where a person is: by the joints, else by the bodies before; None where nothing says it."""
        try:
            targets = make_joint_targets(self._model, person.joints)
        except InputError:
            track = self._tracks.get(person.id)
            return None if track is None else track.tracker.predict(stamp)
        return body_from_joints(self._model, self._people.fitter.gauss_newton, targets, FEW_STEPS)

    def _list_capsules(self, body: BodyState | None) -> F64:
        return np.empty((0, 8)) if body is None else self._people.list_body(self._people.find_joints(body))

    def _start_track(self, identity: str, stamp: int) -> _RigTrack:
        return _RigTrack(identity, BodyTracker(self._people.fitter, self._settings), stamp)

    def _drop_unusable(
        self, person: SilhouettePerson, cloud: PersonCloud | None, people: Sequence[SilhouettePerson]
    ) -> SilhouettePerson:
        """Return a person without the silhouettes that do not show where their points are.

        Others may hide them; silhouettes that contradict moment after moment are told of in one sentence.
        """
        others = [other for other in people if other is not person]
        hidden, wrong = ([], []) if cloud is None else person.find_unusable(cloud.points, others)
        for name in person.views:
            key = person.id, name
            self._contradictions[key] = self._contradictions.get(key, 0) + 1 if name in wrong else 0
            if self._contradictions[key] == MAX_CONTRADICTIONS:
                self._report.warn(
                    f"what the depth sensors saw of a person lies beside the silhouette of {name}, which is left out: "
                    "check the transforms on /tf, the camera_info and the clocks of both"
                )
        self._report.counters["silhouettes that depth contradicts"] += len(wrong)
        kept = {name: view for name, view in person.views.items() if name not in (*hidden, *wrong)}
        return replace(person, views=kept)

    def _fit(self, job: _RigJob, stamp: int) -> BodyFit | InputError | None:
        """Return a person's body; None where too little is known."""
        track, cloud, person = job.track, job.cloud, job.person
        try:
            if person is None:
                if cloud is None:
                    return None
                fit = track.tracker.track(cloud)
                return None if track.tracker.lost else fit
            if cloud is None and not can_stand_alone(person):
                return None
            last = track.tracker.last if stamp - track.stamp <= MAX_AGE_NS else None
            fit = self._fitter.fit(cloud, person, last.state if last is not None and last.reliable else None)
        except InputError as error:
            return error
        track.tracker.start(cloud or PersonCloud(fit.vertices, None, stamp), fit)
        return fit
