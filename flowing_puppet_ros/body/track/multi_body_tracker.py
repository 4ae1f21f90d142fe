# SPDX-License-Identifier: Apache-2.0
"""Track several people through a stream of clouds: each keeps an id while seen and a while beyond.

A full fit takes seconds, a tracked step a fraction of one. So in a live stream new people, and people who were lost,
queue for a full fit, one at a time, while everybody else is tracked on; who is seen from all sides and stands as
people mostly do has a body at once. A recording waits: all new people have their full fit in the cloud that shows them
first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.assignment import assign_cheapest
from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.settings import BodyTrackerSettings
from flowing_puppet_ros.body.track.background_fit import BackgroundFit, SeededCloud
from flowing_puppet_ros.body.track.body_tracker import BodyTracker
from flowing_puppet_ros.body.track.person_track import AT_ONCE_INTERVAL_NS, Judge, PersonTrack, track_person
from flowing_puppet_ros.body.track.tracked_body import TrackedBody
from flowing_puppet_ros.body.upright.found_body import ExpectedPerson
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.ids import letters_of_seed
from flowing_puppet_ros.process.threads import parallel_map, usable_threads
from flowing_puppet_ros.reporting import Report
from flowing_puppet_ros.settings import setting

MATCH_DISTANCE_M = 0.6  # between the middle of a person's cloud and where it is expected
MATCH_SPEED_M_PER_S, MAX_MATCH_DISTANCE_M = 2.0, 2.5  # by which that grows while unseen, and up to which
NO_BODY_PENALTY_M = 0.6  # for tracks without a body, which are often fragments of a neighbour
OWNED_FACTOR = 0.3  # of the distance where the track's body lies in the cloud
MAX_OTHER_WAY_RATIO = 0.8
"""Two-way distance of a full fit that faces the other way, relative to the tracked body's, up to which it is taken."""
ROUGH_OTHER_WAY_RATIO = 1.25
"""The same where the tracked body is a rough one: nobody compared both ways then."""
BODY_STRIDE = 8  # every so many vertices stand for a body
MAX_FITS_AT_ONCE = 4  # new people in one cloud of a live stream who have a body in it
MAX_LIVE_STEPS = 3  # Gauss-Newton steps a scan of a live stream: a scan that is answered late costs more than two steps
MAX_LIVE_ASKED = 2
"""Bodies about which one scan of a live stream is asked, so that nobody waits for the others; one if all are shown."""

Fitted = BodyFit | InputError | None
"""What came of a person's cloud: a body, why there is none, or nothing yet."""


@dataclass(frozen=True)
class MultiBodyTrackerSettings(BodyTrackerSettings):
    """Settings of `MultiBodyTracker`."""

    hold: float = setting(2.0, "time for which a person out of sight keeps the id", unit="s", low=0.0, high=60.0)


class MultiBodyTracker:
    """Tracks everybody in the clouds of one sensor.

    In line (the default) full fits are made in the cloud that needs them, of all new people and of at most one who was
    fitted before: the same clouds give the same bodies. On an executor one runs beside the clouds, and catches up with
    those that came in the meantime before its body is shown: what a live node needs. Which cloud shows it first depends
    on the time it took.
    """

    def __init__(
        self, fitter: BodyFitter, settings: MultiBodyTrackerSettings, seed: int, report: Report | None = None
    ) -> None:
        """Fit with `fitter`; the first ids begin with b, and with more letters for seeds above 0.

        `report` counts tracked people, full fits and lost people, and is told of clouds that cannot be used.
        """
        self._fitter = fitter
        self._settings = settings
        self._report = report or Report()
        self._threads = usable_threads(fitter.settings.threads)
        self._prefix = "b" + (letters_of_seed(seed) if seed else "")
        self._started = 0
        self._tracks: list[PersonTrack] = []
        self._background_fit = BackgroundFit()
        self._stamp: int | None = None
        self._hurries = False

    def reset(self) -> None:
        """Forget everybody; ids go on, so that none is used twice in a run."""
        self._tracks = []
        self._background_fit.stop()
        self._stamp = None

    @property
    def occluded_ids(self) -> list[str]:
        """Ids of the people who have a body and were not seen in the last cloud."""
        return [track.id for track in self._tracks if track.tracker.last and track.stamp != self._stamp]

    def predict_bodies(self, stamp: int) -> list[F64]:
        """Return points (K, 3) m on the body of each track, where it should be at a time in ns; none without a body."""
        found = []
        for track in self._tracks:
            moved, fit = track.predict_middle(stamp) - track.middle, track.tracker.last
            found.append(fit.vertices[::BODY_STRIDE] + moved if fit else np.empty((0, 3)))
        return found

    def expect_people(self, stamp: int) -> list[ExpectedPerson]:
        """Return where everybody may be at a time in ns, in the order of `predict_bodies`."""
        return [track.expect(stamp) for track in self._tracks]

    def step(
        self,
        people: Sequence[PersonCloud],
        stamp: int,
        seed: int,
        executor: Executor | None = None,
        first: Mapping[int, BodyFit] = MappingProxyType({}),
        judge: Judge | None = None,
        sensor_moves: bool = False,
    ) -> list[TrackedBody]:
        """Track everybody to the people of the next cloud.

        Args:
            people: as `segment_people` finds them, `owner` by the order of `predict_bodies(stamp)`.
            stamp: of the cloud in nanoseconds; one before the last restarts the tracker.
            seed: of what is random in this cloud.
            executor: where full fits run; None: in line.
            first: bodies of new people that are known already, by their index in `people`.
            judge: tells whether a body is a person; who is none is not shown, and forgotten in the end.
            sensor_moves: whether furniture seems to move, too.

        Returns:
            The bodies of everybody who is seen and has one, in the order of their ids.
        """
        if self._stamp is not None and stamp < self._stamp:
            self.reset()
        self._stamp = stamp
        self._hurries = executor is not None and judge is not None
        self._adopt_finished_fit()
        matched = self._associate(people, stamp)
        started: dict[int, BodyFit] = {}
        for track, person in matched:
            known = next((fit for index, fit in first.items() if people[index] is person), None)
            if known is not None and track.tracker.last is None:
                track.start(person, known, rough=executor is not None)
                started[track.number] = known
        followed = [pair for pair in matched if pair[0].number not in started]
        tracked = iter(parallel_map(track_person, followed, self._threads))
        fitted = [started[track.number] if track.number in started else next(tracked) for track, _ in matched]
        if judge is not None:
            fitted = self._drop_doubles(matched, fitted)
            matched = [pair for pair in matched if pair[0] in self._tracks]
        due = self._choose_asked(matched, stamp, live=executor is not None)
        bodies: list[TrackedBody] = []
        new: list[tuple[PersonTrack, SeededCloud]] = []
        waiting: list[tuple[PersonTrack, SeededCloud]] = []
        for (track, person), fit in zip(matched, fitted, strict=True):
            if isinstance(fit, InputError):
                self._report.count_unusable(fit)
                continue
            if judge is not None and fit is not None and track.number not in started:
                fit = track.weigh(person, fit, judge if track.number in due else None, sensor_moves)
            if fit is not None and track.prove(person, fit):
                bodies.append(track.show(fit))
            cloud = SeededCloud(person, _person_seed(seed, track.number))
            if fit is None:
                new.append((track, cloud))
            if not self._background_fit.add(track.number, cloud) and (
                track.wants_fit(fit, stamp, seldom=self._hurries)
            ):
                waiting.append((track, cloud))
        self._report.counters["tracked people"] += len(bodies)
        self._drop_lost(stamp)
        if executor is not None:
            bodies += self._fit_at_once(new)
            waiting = [pair for pair in waiting if pair[0].tracker.lost or not pair[0].shows_reliable]
        bodies += self._start_fit(waiting, executor)
        return sorted(bodies, key=lambda body: (len(body.id), body.id))

    def step_one(self, person: PersonCloud, seed: int, executor: Executor | None = None) -> list[TrackedBody]:
        """Track like `step` in clouds that all show one and the same person, wherever they are."""
        for track in self._tracks:
            track.middle, track.velocity = person.middle, np.zeros(3)
        return self.step([person], person.stamp, seed, executor)

    def associate_only(self, people: Sequence[PersonCloud], stamp: int) -> list[tuple[str, PersonCloud]]:
        """Return who the people of the next cloud are, without tracking their bodies."""
        if self._stamp is not None and stamp < self._stamp:
            self.reset()
        self._stamp = stamp
        named = [(track.id, person) for track, person in self._associate(people, stamp)]
        self._drop_lost(stamp)
        return named

    def _fit_at_once(self, new: list[tuple[PersonTrack, SeededCloud]]) -> list[TrackedBody]:
        """Return the bodies of new people who are seen from all sides and to whom one comes close in no time.

        Whose full fit runs beside the clouds is tried too: it takes seconds while clouds come fast.
        """
        new = [pair for pair in new if pair[1].person.stamp - pair[0].tried >= AT_ONCE_INTERVAL_NS]
        new = [pair for pair in new if pair[1].person.viewpoint is None and pair[1].person.field is None]
        new = new[:MAX_FITS_AT_ONCE]
        bodies = []
        for (track, cloud), fit in zip(new, parallel_map(self._try_at_once, new, self._threads), strict=True):
            track.tried = cloud.person.stamp
            if fit is not None:
                track.tracker.start(cloud.person, fit)
                track.fitted = cloud.person.stamp
                bodies += [track.show(fit)] if track.prove(cloud.person, fit) else []
        return bodies

    def _try_at_once(self, pair: tuple[PersonTrack, SeededCloud]) -> BodyFit | None:
        try:
            return self._fitter.fit_at_once(pair[1].person.points, pair[1].person.normals)
        except InputError:
            return None

    def _start_fit(
        self, waiting: list[tuple[PersonTrack, SeededCloud]], executor: Executor | None
    ) -> list[TrackedBody]:
        """Start a full fit of the person who needs it most; in line finish it, or those of all who are new."""
        if not waiting or self._background_fit.busy:
            return []
        # Who has no body comes first, then who was fitted least often, then who has waited longest.
        waiting = sorted(waiting, key=lambda pair: (pair[0].tracker.last is not None, pair[0].fits, pair[0].number))
        new = [] if executor is not None else [pair for pair in waiting if not pair[0].fits]
        return [body for pair in new or waiting[:1] for body in self._start_one_fit(*pair, executor)]

    def _start_one_fit(self, track: PersonTrack, cloud: SeededCloud, executor: Executor | None) -> list[TrackedBody]:
        """Start a full fit; return the body if it is finished and the first of this person."""
        track.fits, track.fitted = track.fits + 1, cloud.person.stamp
        self._report.counters["searches"] += 1
        known = track.tracker.last
        # Live, a body that may have a limb wrong is shown and tracked while a better one is searched.
        quick = executor is not None and known is None
        upright = executor is not None and track.uprights > 0
        track.uprights -= upright
        self._background_fit.start(track.number, track.tracker.fork(quick, upright), cloud, executor)
        self._adopt_finished_fit()
        fit = track.tracker.last
        return [track.show(fit)] if known is None and fit is not None and track.prove(cloud.person, fit) else []

    def _adopt_finished_fit(self) -> None:
        """Take over the tracker that a full fit has led to, unless the track's own is closer by now."""
        finished = self._background_fit.take_finished()
        if finished is None:
            return
        number, tracker = finished
        for track in self._tracks:
            if track.number != number:
                continue
            if tracker.last is not None and _is_better(
                tracker.last, track.tracker.last, ROUGH_OTHER_WAY_RATIO if track.rough else MAX_OTHER_WAY_RATIO
            ):
                track.adopt(tracker)
            elif tracker.last is not None:
                track.tracker.accept()
            track.rough = False

    def _choose_asked(self, seen: Sequence[tuple[PersonTrack, PersonCloud]], stamp: int, live: bool) -> set[int]:
        """Return the numbers of the tracks about which a scan is asked; live, of few who were asked least, in turns."""
        due = sorted((track for track, _ in seen if track.is_due(stamp)), key=PersonTrack.rank_asked)
        if live:
            waiting = sum(not track.is_shown for track in due)
            due = due[: min(max(waiting, 1), MAX_LIVE_ASKED)]
        return {track.number for track in due}

    def _associate(self, people: Sequence[PersonCloud], stamp: int) -> list[tuple[PersonTrack, PersonCloud]]:
        """Match the people to the tracks at minimum total cost; the others start tracks."""
        middles = [person.middle for person in people]
        cost = np.full((len(self._tracks), len(people)), np.inf)
        for row, track in enumerate(self._tracks):
            unseen = 1e-9 * (stamp - track.stamp)
            limit = min(MATCH_DISTANCE_M + MATCH_SPEED_M_PER_S * unseen, MAX_MATCH_DISTANCE_M)
            for column, (person, middle) in enumerate(zip(people, middles, strict=True)):
                distance = float(np.linalg.norm(middle - track.predict_middle(stamp)))
                if distance < limit:
                    penalty = 0.0 if track.tracker.last else NO_BODY_PENALTY_M
                    cost[row, column] = penalty + distance * (OWNED_FACTOR if person.owner == row else 1.0)
        rows, columns = assign_cheapest(np.minimum(cost, 1e3))
        pairs = zip(rows, columns, strict=True)
        matched = {int(column): self._tracks[row] for row, column in pairs if cost[row, column] < np.inf}
        for column, middle in enumerate(middles):
            if column in matched:
                matched[column].update(middle, stamp)
            elif people[column].owner is None:
                matched[column] = self._start_track(middle, stamp, people[column].proven)
        return [(matched[column], person) for column, person in enumerate(people) if column in matched]

    def make_id(self) -> str:
        """Return an id that nobody had before."""
        self._started += 1
        return f"{self._prefix}{self._started}"

    def _start_track(self, middle: F64, stamp: int, proven: bool) -> PersonTrack:
        steps = self._settings.gauss_newton_steps
        steps = min(steps, MAX_LIVE_STEPS) if self._hurries else steps
        name, tracker = self.make_id(), BodyTracker(self._fitter, replace(self._settings, gauss_newton_steps=steps))
        self._tracks.append(PersonTrack(name, self._started, middle, stamp, tracker, proven=proven))
        return self._tracks[-1]

    def _drop_doubles(
        self, matched: Sequence[tuple[PersonTrack, PersonCloud]], fitted: Sequence[Fitted]
    ) -> list[Fitted]:
        """Drop who is another person of the same cloud, and return what was fitted to the others."""
        seen = [track for track, _ in matched]
        doubles = [track for track in seen if any(track.is_double_of(other) for other in seen)]
        self._tracks = [track for track in self._tracks if track not in doubles]
        return [fit for track, fit in zip(seen, fitted, strict=True) if track not in doubles]

    def _drop_lost(self, stamp: int) -> None:
        kept = [track for track in self._tracks if stamp - track.stamp <= 1e9 * self._settings.hold]
        self._report.counters["lost people"] += sum(track.tracker.last is not None for track in self._tracks) - sum(
            track.tracker.last is not None for track in kept
        )
        self._tracks = [track for track in kept if track.belief is None or not track.belief.is_hopeless]


def _is_better(full: BodyFit, own: BodyFit | None, other_way: float) -> bool:
    """Return whether a full fit is closer than the tracked body, by the ratio `other_way` where it faces another."""
    if own is None:
        return True
    same = own.state.rotation[0, :2, 0] @ full.state.rotation[0, :2, 0] > 0
    return full.two_way_distance < (1.0 if same else other_way) * own.two_way_distance


def _person_seed(seed: int, number: int) -> int:
    """Return a seed for one person in one cloud."""
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
