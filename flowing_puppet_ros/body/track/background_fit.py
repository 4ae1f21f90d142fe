# SPDX-License-Identifier: Apache-2.0
"""A full fit of one person that catches up with the clouds that came while it ran, in line or beside them."""

from __future__ import annotations

import threading
from concurrent.futures import Executor
from typing import NamedTuple

from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.track.body_tracker import BodyTracker
from flowing_puppet_ros.errors import InputError

CATCH_UP_SPACING_NS = 300_000_000
"""Minimum time between the clouds that are kept while a fit is made."""
MAX_KEPT = 8
"""Maximum number of clouds that are kept."""
NEARLY_DONE = 2
"""So few clouds left that the body is nearly there."""


class SeededCloud(NamedTuple):
    """A person's cloud, and the seed of a full fit to it."""

    person: PersonCloud
    seed: int


class _StoppedError(Exception):
    """The fit is no longer wanted."""


class _FitJob:
    """One background fit of one person."""

    def __init__(self, number: int, tracker: BodyTracker, first: SeededCloud) -> None:
        self.number = number
        self.tracker = tracker
        self.first = first
        self.backlog: list[SeededCloud] = []
        self.spacing_ns = CATCH_UP_SPACING_NS
        self.lock = threading.Lock()
        self.stopped = False
        self.done = False
        self.problem: Exception | None = None

    def add(self, cloud: SeededCloud) -> bool:
        """Keep a few clouds for when the fit is made, and the newest; False when the job is done."""
        with self.lock:
            if self.done:
                return False
            before = self.backlog[-2] if len(self.backlog) > 1 else self.first
            if self.backlog and self.backlog[-1].person.stamp - before.person.stamp < self.spacing_ns:
                self.backlog.pop()
            self.backlog.append(cloud)
            if len(self.backlog) > MAX_KEPT:
                # Still evenly spaced, so that the longest fit leaves no more to catch up with.
                self.backlog, self.spacing_ns = [*self.backlog[1::2], cloud], 2 * self.spacing_ns
            return True

    def run(self) -> None:
        """Make the fit and catch up; `done` when that is finished, or a `problem` has ended it."""
        try:
            self._run()
        except Exception as error:
            with self.lock:
                self.problem, self.done = error, True

    def _run(self) -> None:
        """Fit the first cloud that can be used, then track through those that were kept, to the newest.

        The person may have turned or sat down meanwhile, so no kept cloud is skipped. New clouds arrive while we catch
        up. Stop once few are left, or once the backlog no longer shrinks because the tracker is the slower one.
        """
        fitted, before = self._try(self.first, refit=True), MAX_KEPT + 1
        while not self.stopped:
            with self.lock:
                clouds, self.backlog, self.spacing_ns = self.backlog, [], CATCH_UP_SPACING_NS
                self.done = not clouds
            for cloud in clouds:
                if not self.stopped:
                    fitted = self._try(cloud, refit=not fitted) or fitted
            if not clouds or (fitted and (len(clouds) <= NEARLY_DONE or len(clouds) >= before)):
                break
            before = len(clouds)
        self.done = True

    def _try(self, cloud: SeededCloud, refit: bool) -> bool:
        """Fit or track a cloud; return whether it could be used."""
        try:
            if refit:
                self.tracker.track_or_refit(cloud.person, cloud.seed, self._check)
            else:
                self.tracker.track(cloud.person)
        except _StoppedError:
            self.stopped = True
        except InputError:
            return False  # the next cloud may do
        return not self.stopped

    def _check(self, _: float) -> None:
        if self.stopped:
            raise _StoppedError


class BackgroundFit:
    """Runs at most one fit at a time."""

    def __init__(self) -> None:
        """Start with none."""
        self._job: _FitJob | None = None

    @property
    def busy(self) -> bool:
        """Whether a fit runs, or its result was not taken yet."""
        return self._job is not None

    def start(self, number: int, tracker: BodyTracker, first: SeededCloud, executor: Executor | None) -> None:
        """Fit the person `number` with `tracker`, which belongs to the job from now on, on `executor` or in line."""
        self._job = _FitJob(number, tracker, first)
        if executor is None:
            self._job.run()
        else:
            executor.submit(self._job.run)

    def add(self, number: int, cloud: SeededCloud) -> bool:
        """Hand the job its person's next cloud; return False when it is not about this person."""
        return self._job is not None and self._job.number == number and self._job.add(cloud)

    def take_finished(self) -> tuple[int, BodyTracker] | None:
        """Return the person and the tracker of a finished job, once; raise what went wrong in it."""
        if self._job is None or not self._job.done:
            return None
        job, self._job = self._job, None
        if job.problem is not None:
            raise job.problem
        return job.number, job.tracker

    def stop(self) -> None:
        """Give up the job; it ends at its next step."""
        if self._job is not None:
            self._job.stopped = True
            self._job = None
