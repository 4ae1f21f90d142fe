# SPDX-License-Identifier: Apache-2.0
"""Several people through a stream of clouds: each keeps an id while seen and a while beyond, and is tracked.

A full fit takes seconds, a tracked step a fraction of one. So new people, and people who were lost, wait in line for a
full fit, one at a time, while everybody else is tracked on.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment

from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.segmentation.people import PersonCloud
from flowing_puppet_ros.body.track.background_fit import BackgroundFit, Task
from flowing_puppet_ros.body.track.body_tracker import BodyTracker, BodyTrackerSettings
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.ids import letters_of_seed
from flowing_puppet_ros.parallel import parallel_map, usable_threads
from flowing_puppet_ros.settings import setting

NEAR = 0.6  # metres by which the middle of a person's cloud may miss where it is expected
SPEED, FARTHEST = 2.0, 2.5  # metres a second by which that grows while unseen, and metres up to which
NEWCOMER = 0.6  # metres that a distance counts more for who has no body yet, as what splits off from somebody
RETRY_NS = 5_000_000_000  # a body that is not reliable is searched again so long after the last search
OWNED = 0.3  # what a distance counts where the person's body lies in the cloud
GAIN = 0.5  # share of a new velocity that is taken
TRUSTED_NS = 1_000_000_000  # a velocity from clouds farther apart than this is none
BODY_POINTS = 8  # every so many vertices stand for a body


@dataclass(frozen=True)
class MultiBodyTrackerSettings(BodyTrackerSettings):
    """Settings of `Crowd`."""

    hold: float = setting(2.0, "time for which a person out of sight keeps the id", unit="s", low=0.0, high=60.0)


@dataclass(slots=True, eq=False)
class _BodyTrack:
    """A person: where the middle (3,) of their points was and how it moves, m/s; what tracks them; the last search."""

    id: str
    number: int
    middle: np.ndarray
    stamp: int
    tracker: BodyTracker
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    searches: int = 0
    searched: int = 0

    def expected(self, stamp: int) -> np.ndarray:
        """Where the middle should be at a later time, nanoseconds."""
        return np.asarray(self.middle + self.velocity * 1e-9 * (stamp - self.stamp))

    def seen(self, middle: np.ndarray, stamp: int) -> None:
        """Take where the person is now."""
        if 0 < stamp - self.stamp <= TRUSTED_NS:
            measured = (middle - self.middle) / (1e-9 * (stamp - self.stamp))
            self.velocity = self.velocity + GAIN * (measured - self.velocity)
        else:
            self.velocity = np.zeros(3)
        self.middle, self.stamp = middle, stamp


class MultiBodyTracker:
    """Tracks everybody in the clouds of one sensor.

    `counters` counts tracked people, searches and lost people, `errors` collects why people could not be used.

    In line (the default) the full fit is made in the cloud that needs it, at most one a cloud: the same clouds give
    the same bodies. On the executor `background` it runs beside the clouds, and catches up with those that came in the
    meantime before its body is shown: what a live node needs. Which cloud shows it first depends on the time it took.
    """

    def __init__(self, fitter: BodyFitter, settings: MultiBodyTrackerSettings, seed: int) -> None:
        """Fit with `fitter`; the first ids begin with b, and with more letters for seeds above 0."""
        self._fitter = fitter
        self._settings = settings
        self._threads = usable_threads(fitter.settings.threads)
        self._prefix = "b" + (letters_of_seed(seed) if seed else "")
        self._started = 0
        self._members: list[_BodyTrack] = []
        self._pursuit = BackgroundFit()
        self.counters: Counter[str] = Counter()
        self.errors: list[InputError] = []
        self._stamp: int | None = None

    def reset(self) -> None:
        """Forget everybody; ids go on, so that none is used twice in a run."""
        self._members = []
        self._pursuit.stop()
        self._stamp = None

    @property
    def occluded_ids(self) -> list[str]:
        """Ids of the people who have a body and were not seen in the last cloud."""
        return [member.id for member in self._members if member.tracker.last and member.stamp != self._stamp]

    def bodies(self, stamp: int) -> list[np.ndarray]:
        """Points (K, 3) on the body of every person, where it should be at a time in nanoseconds; none without one."""
        found = []
        for member in self._members:
            moved, fit = member.expected(stamp) - member.middle, member.tracker.last
            found.append(fit.vertices[::BODY_POINTS] + moved if fit else np.empty((0, 3)))
        return found

    def step(
        self,
        people: Sequence[PersonCloud],
        stamp: int,
        viewpoint: np.ndarray | None,
        seed: int,
        background: Executor | None = None,
    ) -> list[tuple[str, BodyFit]]:
        """Track everybody to the people of the next cloud.

        Args:
            people: as `extract_people` finds them, `owner` by the order of `bodies(stamp)`.
            stamp: nanoseconds; one before the last starts anew.
            viewpoint: (3,) where the sensor stood when the cloud shows one side only.
            seed: of what is random in this cloud.
            background: where full fits run; None: in line.

        Returns:
            (id, fit) of everybody who is seen and has a body.
        """
        if self._stamp is not None and stamp < self._stamp:
            self.reset()
        self._stamp = stamp
        self._adopt_finished_fit()
        seen = self._associated(people, stamp)
        tasks = [
            Task(person.points, person.normals, stamp, viewpoint, _person_seed(seed, member.number))
            for member, person in seen
        ]
        followed = parallel_map(
            _follow, [(m.tracker, task) for (m, _), task in zip(seen, tasks, strict=True)], self._threads
        )
        fits: list[tuple[str, BodyFit]] = []
        wanting: list[tuple[_BodyTrack, Task]] = []
        for (member, _), task, fit in zip(seen, tasks, followed, strict=True):
            if isinstance(fit, InputError):
                self.errors.append(fit)
                continue
            if fit is not None:
                fits.append((member.id, fit))
            doubtful = fit is not None and not fit.reliable and stamp - member.searched >= RETRY_NS
            if not self._pursuit.add(member.number, task) and (member.tracker.lost or doubtful):
                wanting.append((member, task))
        self.counters["tracked people"] += len(fits)
        self._forget(stamp)
        fits += self._search(wanting, background)
        return sorted(fits, key=lambda pair: (len(pair[0]), pair[0]))

    def step_one(
        self,
        person: PersonCloud,
        stamp: int,
        viewpoint: np.ndarray | None,
        seed: int,
        background: Executor | None = None,
    ) -> list[tuple[str, BodyFit]]:
        """As `step`, for clouds that all show one and the same person, wherever they are."""
        for member in self._members:
            member.middle, member.velocity = np.median(person.points, axis=0), np.zeros(3)
        return self.step([person], stamp, viewpoint, seed, background)

    def associate_only(self, people: Sequence[PersonCloud], stamp: int) -> list[tuple[str, PersonCloud]]:
        """Say who the people of the next cloud are, without tracking their bodies."""
        if self._stamp is not None and stamp < self._stamp:
            self.reset()
        self._stamp = stamp
        named = [(member.id, person) for member, person in self._associated(people, stamp)]
        self._forget(stamp)
        return named

    def _search(self, wanting: list[tuple[_BodyTrack, Task]], background: Executor | None) -> list[tuple[str, BodyFit]]:
        """Start a full fit of the person who needs it most; in line it is finished when this returns."""
        if not wanting or self._pursuit.busy:
            return []
        # Who has no body comes first, then who was searched least, then who has waited longest.
        member, task = min(
            wanting, key=lambda pair: (pair[0].tracker.last is not None, pair[0].searches, pair[0].number)
        )
        member.searches, member.searched = member.searches + 1, task.stamp
        self.counters["searches"] += 1
        known = member.tracker.last
        # Live, a body that may have a limb wrong is shown and followed while a better one is searched.
        quick = background is not None and known is None
        self._pursuit.start(member.number, member.tracker.fork(quick), task, background)
        self._adopt_finished_fit()
        fit = member.tracker.last
        return [(member.id, fit)] if known is None and fit is not None else []

    def _adopt_finished_fit(self) -> None:
        """Take over the tracker that a full fit has led to, unless the person's own is closer by now."""
        done = self._pursuit.finished()
        if done is None:
            return
        number, tracker = done
        for member in self._members:
            if member.number == number and tracker.last is not None:
                own = member.tracker.last
                if own is None or tracker.last.two_way_distance < own.two_way_distance:
                    member.tracker = tracker
                else:
                    member.tracker.accept()

    def _associated(self, people: Sequence[PersonCloud], stamp: int) -> list[tuple[_BodyTrack, PersonCloud]]:
        """Who each of the people is: the least summed distance from where they should be; the rest are new."""
        middles = [np.median(person.points, axis=0) for person in people]
        cost = np.full((len(self._members), len(people)), np.inf)
        for row, member in enumerate(self._members):
            limit = min(NEAR + SPEED * 1e-9 * (stamp - member.stamp), FARTHEST)
            for column, (person, middle) in enumerate(zip(people, middles, strict=True)):
                apart = float(np.linalg.norm(middle - member.expected(stamp)))
                if apart < limit:
                    extra = 0.0 if member.tracker.last else NEWCOMER
                    cost[row, column] = extra + apart * (OWNED if person.owner == row else 1.0)
        rows, columns = linear_sum_assignment(np.minimum(cost, 1e3))
        matched = {int(column): self._members[row] for row, column in zip(rows, columns, strict=True)
                   if cost[row, column] < np.inf}  # fmt: skip
        for column, middle in enumerate(middles):
            if column in matched:
                matched[column].seen(middle, stamp)
            elif people[column].owner is None:
                matched[column] = self._new(middle, stamp)
        return [(matched[column], person) for column, person in enumerate(people) if column in matched]

    def _new(self, middle: np.ndarray, stamp: int) -> _BodyTrack:
        self._started += 1
        tracker = BodyTracker(self._fitter, self._settings)
        self._members.append(_BodyTrack(f"{self._prefix}{self._started}", self._started, middle, stamp, tracker))
        return self._members[-1]

    def _forget(self, stamp: int) -> None:
        kept = [member for member in self._members if stamp - member.stamp <= 1e9 * self._settings.hold]
        self.counters["lost people"] += sum(member.tracker.last is not None for member in self._members) - sum(
            member.tracker.last is not None for member in kept
        )
        self._members = kept


def _follow(pair: tuple[BodyTracker, Task]) -> BodyFit | InputError | None:
    tracker, task = pair
    try:
        return tracker.track(task.points, task.normals, task.stamp, task.viewpoint)
    except InputError as error:
        return error


def _person_seed(seed: int, number: int) -> int:
    """A seed of one person in one cloud."""
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
