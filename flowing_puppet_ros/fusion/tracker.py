# SPDX-License-Identifier: Apache-2.0
"""Track the people whom a camera sees as puppets through the clouds of a sensor, each under the puppet's id.

puppet | depth | what is done
yes    | yes   | the body moves on by a few steps, with the joints as soft evidence across their rays;
|       | a new or lost one is fitted anew from the joints
yes    | no    | the person keeps the id and has no body in this cloud
no     | yes   | who is known is tracked by the cloud alone for as long as ids are held; nobody is new
no     | no    | the id is held for a while
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from flowing_puppet_ros.arrays import Bools
from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.body.segmentation.planes import PlaneCache
from flowing_puppet_ros.body.settings import BodyTrackerSettings
from flowing_puppet_ros.body.track.body_tracker import BodyTracker
from flowing_puppet_ros.body.track.tracked_body import TorsoMotion, TrackedBody
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.cloud.range_image import RangeImage
from flowing_puppet_ros.fusion.people_fitter import Claim, PeopleFitter, make_person
from flowing_puppet_ros.fusion.puppet_joints import PuppetJoints
from flowing_puppet_ros.fusion.seen_cloud import SeenCloud
from flowing_puppet_ros.model.sp import BodyState
from flowing_puppet_ros.process.threads import one_blas_thread, parallel_map
from flowing_puppet_ros.reporting import Report

REFIT_INTERVAL_NS, LIMB_INTERVAL_NS = 1_000_000_000, 250_000_000
"""From one fit of an unreliable body from its joints to the next, and from one search for a lost limb to the next."""
MAX_PATIENCE = 16
"""Times the former: it doubles with every fit that finds nothing better, which takes as long as ten clouds. A limb that
is not found in one cloud often is in the next."""
BETTER_SHARE = 0.95
"""Two-way distance of a new fit, relative to the tracked body's, below which it is better."""
MAX_PLANE_CLOUDS = 40
"""Clouds after which floor and walls are searched again though they are still there."""
MAX_STEPS = 2
"""Gauss-Newton steps a cloud: the joints say where the limbs are, and more steps bring a body no closer."""
MAX_SAME_PERSON_M = 0.6
"""Between the trunks of a puppet without an id and of the known body that it is."""


@dataclass(slots=True)
class _Retry:
    """When something that takes long is worth another attempt: `stamp` ns of the last one, and the interval to it.

    The interval doubles with every attempt in vain, up to `max_patience` times.
    """

    interval: int
    max_patience: int = 1
    stamp: int | None = None
    patience: int = 1

    def is_due(self, stamp: int) -> bool:
        """Return whether it is time for another attempt."""
        return self.stamp is None or stamp - self.stamp >= self.patience * self.interval

    def record(self, stamp: int, success: bool) -> None:
        """Take note of an attempt."""
        self.stamp, self.patience = stamp, 1 if success else min(2 * self.patience, self.max_patience)


@dataclass(slots=True, eq=False)
class _PuppetTrack:
    """One person: the `stamp` ns of the last sign, whether it is `proven`, and what was tried for it.

    `refit` from joints, and a search for each limb by its number. `checked`: whether a fit has told left from right.
    """

    id: str
    tracker: BodyTracker
    stamp: int
    refit: _Retry = field(default_factory=lambda: _Retry(REFIT_INTERVAL_NS, MAX_PATIENCE))
    searches: dict[int, _Retry] = field(default_factory=dict)
    proven: bool = False
    checked: bool = False
    motion: TorsoMotion = field(default_factory=TorsoMotion)


@dataclass(frozen=True, slots=True, eq=False)
class _TrackJob:
    """What one person is tracked with; `joints` is None without a puppet."""

    track: _PuppetTrack
    person: PersonCloud
    claim: Claim | None


class FusedTracker:
    """Tracks the people in view of one camera."""

    def __init__(
        self,
        people: PeopleFitter,
        settings: BodyTrackerSettings,
        hold: float,
        report: Report | None = None,
        publish_id: Callable[[str], str] = str,
    ) -> None:
        """Fit with `people`; ids are held for `hold` seconds without a sign of the person.

        `publish_id` turns the names of puppets without ids (p1, p2, ...) into ids.
        """
        self._people = people
        self._publish_id = publish_id
        self._settings = replace(settings, gauss_newton_steps=min(settings.gauss_newton_steps, MAX_STEPS))
        self._hold_ns = round(1e9 * hold)
        self._report = report or Report()
        self._named = 0
        self.reset()

    def reset(self) -> None:
        """Forget everybody; made-up ids go on, so that none is used twice."""
        self._tracks: dict[str, _PuppetTrack] = {}
        self._planes = PlaneCache(MAX_PLANE_CLOUDS)
        self._stamp: int | None = None
        self._shown: set[str] = set()

    @property
    def occluded_ids(self) -> list[str]:
        """Ids of the people who have had a body and have none in the last cloud."""
        return [track.id for track in self._tracks.values() if track.proven and track.id not in self._shown]

    def step(
        self, cloud: SeenCloud, image: RangeImage | None, puppets: Sequence[PuppetJoints], stamp: int
    ) -> tuple[list[TrackedBody], Bools]:
        """Return the bodies of everybody who is seen, and which points (N,) are theirs.

        Whoever comes into a running stream has a body at once, by a quick fit, and a thorough one in the next cloud. In
        the first cloud all fits are thorough, since there may be no other.

        Args:
            cloud: with the pixels of the camera that saw the puppets.
            image: the cloud's range image, of which each person's field is made.
            puppets: at the time of the cloud.
            stamp: of the cloud in nanoseconds; one before the last restarts the tracker.
        """
        if self._stamp is not None and stamp < self._stamp:
            self.reset()
        is_first, self._stamp = self._stamp is None, stamp
        with one_blas_thread():
            jobs, own = self._share_out(cloud, image, self._name(puppets, cloud, stamp), stamp)
            fits = parallel_map(lambda job: self._track(job, stamp, not is_first), jobs, self._people.threads)
        found: list[TrackedBody] = []
        for job, fit in zip(jobs, fits, strict=True):
            if isinstance(fit, InputError):
                self._report.count_unusable(fit)
            elif fit is not None:
                job.track.stamp = stamp
                job.track.proven = job.track.proven or self._people.is_proven(fit)
                if job.track.proven:
                    hidden = job.track.tracker.hidden
                    found.append(job.track.motion.add(job.track.id, stamp, fit, hidden))
        self._shown = {body.id for body in found}
        self._report.counters["tracked people"] += len(found)
        self._drop_lost(stamp)
        return sorted(found, key=lambda body: (len(body.id), body.id)), own

    def step_alone(
        self, cloud: SeenCloud, image: RangeImage | None, puppets: Sequence[PuppetJoints]
    ) -> tuple[list[TrackedBody], Bools]:
        """Return the bodies in a cloud that nothing joins to those before, and which points (N,) are in view.

        No track is used or changed. Puppets without an id have a new one.
        """
        named = [puppet if puppet.id else replace(puppet, id=self._make_id()) for puppet in puppets]
        bodies = [TrackedBody(identity, fit) for identity, fit in self._people.fit_people(cloud, named, image)]
        return sorted(bodies, key=lambda body: (len(body.id), body.id)), cloud.in_view

    def _make_id(self) -> str:
        self._named += 1
        return self._publish_id(f"p{self._named}")

    def _share_out(
        self, cloud: SeenCloud, image: RangeImage | None, puppets: Sequence[PuppetJoints], stamp: int
    ) -> tuple[list[_TrackJob], Bools]:
        """Return what everybody is tracked with, and which points (N,) are anybody's."""
        clear, floor = self._people.find_clear(cloud.points, self._planes, cloud.viewpoint)
        seen = {puppet.id for puppet in puppets}
        known = {identity: track.tracker.predict(stamp) for identity, track in self._tracks.items()}
        alone = {identity: body for identity, body in known.items() if body is not None and identity not in seen}
        bodies: list[BodyState | None] = [known.get(puppet.id) for puppet in puppets]
        claims, unclaimed = self._people.claim(cloud, puppets, clear, bodies, list(alone.values()))
        jobs = []
        for claim in claims:
            track = self._tracks.get(claim.puppet.id) or self._start_track(claim.puppet.id, stamp)
            blanks = self._people.find_blanks(claim.joints)
            person = make_person(cloud, image, claim.own, floor, stamp, blanks)
            jobs.append(_TrackJob(track, person, claim))
        for identity, own in zip(alone, unclaimed, strict=True):
            if np.count_nonzero(own) >= self._people.min_points:
                person = make_person(cloud, image, own, floor, stamp)
                jobs.append(_TrackJob(self._tracks[identity], person, None))
        for puppet in puppets:
            if puppet.id in self._tracks:
                self._tracks[puppet.id].stamp = stamp
        anybody = np.zeros(len(cloud.points), dtype=bool)
        for job in jobs:
            anybody[job.person.rows] = True
        return jobs, anybody

    def _track(self, job: _TrackJob, stamp: int, is_running: bool) -> BodyFit | InputError | None:
        """Return the person's body: tracked, or fitted from the joints where there is none, or none that is good."""
        track, tracker, claim = job.track, job.track.tracker, job.claim
        try:
            predicted = tracker.predict(stamp)
            targets = None if claim is None else self._make_targets(claim, predicted)
            places = None if claim is None else self._people.find_places(claim)
            fit = tracker.track(job.person, targets, places, self._point_limbs(predicted, claim))
            if claim is None:
                return None if tracker.lost else fit
            due = fit is not None and not tracker.hidden and not fit.reliable and track.refit.is_due(stamp)
            if fit is None or tracker.lost or due or not track.checked:
                quick = track.checked if fit is not None else is_running
                fresh = self._people.fit_claim(claim, job.person, tracker.cloud, quick)
                track.checked = not quick or fit is not None
                limit = np.inf if fit is None else BETTER_SHARE * fit.two_way_distance
                better = fresh is not None and fresh.two_way_distance < limit
                track.refit.record(stamp, better)
                if fit is None or better:
                    if fresh is not None:
                        tracker.start(job.person, fresh)
                    return fresh
                tracker.accept()
            fit = self._find_lost_limbs(job, fit, claim, stamp)
        except InputError as error:
            return error
        return fit

    def _point_limbs(self, body: BodyState | None, claim: Claim | None) -> BodyState | None:
        """Return the predicted body with the limbs pointed to their joints that are surely seen elsewhere."""
        if body is None or claim is None:
            return body
        limbs = self._people.joint_fitter.limbs
        strayed = limbs.find_strayed(body, claim.joints)
        if not strayed:
            return body
        self._report.counters["limbs pointed to their joints"] += len(strayed)
        return limbs.point(body, claim.joints, strayed)

    def _find_lost_limbs(self, job: _TrackJob, fit: BodyFit, claim: Claim, stamp: int) -> BodyFit:
        """Return the body with the limbs hung anew that the puppet sees elsewhere."""
        track, fitter = job.track, self._people.joint_fitter
        joints = fitter.limbs.lift_left_out(fit, job.person.points, claim.joints)
        lost = fitter.limbs.find_lost(fit.state, joints)
        tries = {limb: track.searches.setdefault(limb, _Retry(LIMB_INTERVAL_NS)) for limb in lost}
        lost = [limb for limb in lost if tries[limb].is_due(stamp)]
        if not lost or track.tracker.hidden:
            return fit
        cloud = fitter.take_cloud(job.person, track.tracker.cloud)
        found = fitter.hang_anew(cloud, fit.state, joints, lost)
        for limb in lost:
            tries[limb].record(stamp, found is not None)
        if found is None:
            return fit
        track.tracker.correct(found, [part for limb in lost for part in fitter.limbs.list_parts(limb)])
        self._report.counters["limbs found again"] += 1
        return found

    def _make_targets(self, claim: Claim, body: BodyState | None) -> JointTargets:
        """Return the joints' pull; those without a depth are at the predicted body's, since only their rays count."""
        targets = self._people.joint_fitter.make_targets(claim.joints)
        if body is None or targets.rays is None:
            return targets
        return self._people.complete_targets(claim, targets, body)

    def _name(self, puppets: Sequence[PuppetJoints], cloud: SeenCloud, stamp: int) -> list[PuppetJoints]:
        """Return the puppets with ids: those without one get that of the known body at their place, or a new one."""
        named = [puppet for puppet in puppets if puppet.id]
        nameless = [puppet for puppet in puppets if not puppet.id]
        if not nameless:
            return named
        free = {
            identity: cloud.camera.project(self._people.find_trunk(track.tracker.last.state))
            for identity, track in self._tracks.items()
            if track.tracker.last is not None and all(puppet.id != identity for puppet in named)
        }
        pairs = []
        for number, puppet in enumerate(nameless):
            for identity, (pixel, depth) in free.items():
                apart = float(np.linalg.norm(self._people.find_trunk_pixel(puppet) - pixel))
                pairs.append((apart * float(depth) / cloud.camera.focal, number, identity))
        names: dict[int, str] = {}
        for gap, number, identity in sorted(pairs):
            if gap < MAX_SAME_PERSON_M and number not in names and identity not in names.values():
                names[number] = identity
        for number, puppet in enumerate(nameless):
            if number not in names:
                names[number] = self._make_id()
            named.append(replace(puppet, id=names[number]))
        return named

    def _start_track(self, identity: str, stamp: int) -> _PuppetTrack:
        track = _PuppetTrack(identity, BodyTracker(self._people.fitter, self._settings), stamp)
        self._tracks[identity] = track
        return track

    def _drop_lost(self, stamp: int) -> None:
        for identity, track in list(self._tracks.items()):
            if stamp - track.stamp > self._hold_ns:
                self._report.counters["lost people"] += track.proven
                del self._tracks[identity]
