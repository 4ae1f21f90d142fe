# SPDX-License-Identifier: Apache-2.0
"""A full fit of one person that catches up with the clouds that came while it ran, in line or beside them."""

from __future__ import annotations

import threading
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.track.body_tracker import BodyTracker
from flowing_puppet_ros.errors import InputError

CATCH_UP_SPACING_NS, MAX_KEPT, FEW = 300_000_000, 8, 2
"""Least time between the clouds kept while a fit is made, how many are, and so few that the body is nearly there."""


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """A person's points (N, 3), normals (N, 3) or None, stamp in nanoseconds, viewpoint (3,) or None, and a seed."""

    points: np.ndarray
    normals: np.ndarray | None
    stamp: int
    viewpoint: np.ndarray | None
    seed: int


class _Stopped(Exception):
    """Nobody wants the fit any more."""


class _FitJob:
    """One pursuit of one person."""

    def __init__(self, number: int, tracker: BodyTracker, task: Task) -> None:
        self.number = number
        self.tracker = tracker
        self.first = task
        self.coming: list[Task] = []
        self.apart = CATCH_UP_SPACING_NS
        self.lock = threading.Lock()
        self.stopped = False
        self.done = False
        self.problem: Exception | None = None

    def add(self, task: Task) -> bool:
        """Keep a few clouds for when the fit is made, and the newest; False when the run is through."""
        with self.lock:
            if self.done:
                return False
            before = self.coming[-2] if len(self.coming) > 1 else self.first
            if self.coming and self.coming[-1].stamp - before.stamp < self.apart:
                self.coming.pop()
            self.coming.append(task)
            if len(self.coming) > MAX_KEPT:
                # Evenly spread still, so that the longest fit leaves no more to follow.
                self.coming, self.apart = [*self.coming[1::2], task], 2 * self.apart
            return True

    def run(self) -> None:
        """Make the fit and catch up; `done` when that is through, or a `problem` has ended it."""
        try:
            self._run()
        except Exception as error:
            with self.lock:
                self.problem, self.done = error, True

    def _run(self) -> None:
        """Fit the first cloud that can be used, then follow through those that were kept to the newest.

        A person may have turned or sat down meanwhile, so nothing between is left out. Clouds come while others are
        followed too; that ends when they are few, or no fewer than before, as where the tracker is the slower one.
        """
        fitted, before = self._took(self.first, search=True), MAX_KEPT + 1
        while not self.stopped:
            with self.lock:
                tasks, self.coming, self.apart = self.coming, [], CATCH_UP_SPACING_NS
                self.done = not tasks
            for task in tasks:
                if not self.stopped:
                    fitted = self._took(task, search=not fitted) or fitted
            if not tasks or (fitted and (len(tasks) <= FEW or len(tasks) >= before)):
                break
            before = len(tasks)
        self.done = True

    def _took(self, task: Task, search: bool) -> bool:
        """Whether this cloud could be used."""
        try:
            self._take(task, search)
        except _Stopped:
            self.stopped = True
        except InputError:
            return False  # the next cloud may do
        return not self.stopped

    def _take(self, task: Task, search: bool) -> None:
        if search:
            self.tracker.track_or_refit(task.points, task.normals, task.stamp, task.viewpoint, task.seed, self._check)
        else:
            self.tracker.track(task.points, task.normals, task.stamp, task.viewpoint)

    def _check(self, _: float) -> None:
        if self.stopped:
            raise _Stopped


class BackgroundFit:
    """At most one run at a time."""

    def __init__(self) -> None:
        """Start with none."""
        self._run: _FitJob | None = None

    @property
    def busy(self) -> bool:
        """Whether a run goes on, or its result was not taken yet."""
        return self._run is not None

    def start(self, number: int, tracker: BodyTracker, task: Task, background: Executor | None) -> None:
        """Fit the person `number` by `tracker`, which belongs to the run from now on, on `background` or in line."""
        self._run = _FitJob(number, tracker, task)
        if background is None:
            self._run.run()
        else:
            background.submit(self._run.run)

    def add(self, number: int, task: Task) -> bool:
        """Hand the run its person's next cloud; False when it is not about this person."""
        return self._run is not None and self._run.number == number and self._run.add(task)

    def finished(self) -> tuple[int, BodyTracker] | None:
        """Return the person and the tracker of a run that is through, once; raises what went wrong in it."""
        if self._run is None or not self._run.done:
            return None
        run, self._run = self._run, None
        if run.problem is not None:
            raise run.problem
        return run.number, run.tracker

    def stop(self) -> None:
        """Give up the run; it ends at its next step."""
        if self._run is not None:
            self._run.stopped = True
            self._run = None
