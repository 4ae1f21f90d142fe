# SPDX-License-Identifier: Apache-2.0
"""A full fit of one person that catches up with the clouds that came while it ran, in line or beside them."""

from __future__ import annotations

import threading
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.tracker import BodyTracker
from flowing_puppet_ros.errors import InputError


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


class _Run:
    """One pursuit of one person."""

    def __init__(self, number: int, tracker: BodyTracker, task: Task) -> None:
        self.number = number
        self.tracker = tracker
        self.first = task
        self.newest: Task | None = None
        self.lock = threading.Lock()
        self.stopped = False
        self.done = False
        self.problem: Exception | None = None

    def add(self, task: Task) -> bool:
        """Keep the newest cloud for when the fit is made; False when the run is through."""
        with self.lock:
            if self.done:
                return False
            self.newest = task
            return True

    def run(self) -> None:
        """Make the fit and catch up; `done` when that is through, or a `problem` has ended it."""
        try:
            self._run()
        except Exception as error:
            with self.lock:
                self.problem, self.done = error, True

    def _run(self) -> None:
        """Fit the first cloud that can be, then follow to the newest, from where whoever takes the body goes on.

        A stream may be faster than the tracker, so to follow every cloud might never come to an end.
        """
        fitted = self._took(self.first, search=True)
        while not self.stopped:
            with self.lock:
                task, self.newest = self.newest, None
                self.done = task is None
            if task is None:
                return
            followed = self._took(task, search=not fitted)
            if fitted:
                self.done = True
                return
            fitted = followed
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
            self.tracker.step(task.points, task.normals, task.stamp, task.viewpoint, task.seed, self._check)
        else:
            self.tracker.follow(task.points, task.normals, task.stamp, task.viewpoint)

    def _check(self, _: float) -> None:
        if self.stopped:
            raise _Stopped


class Pursuit:
    """At most one run at a time."""

    def __init__(self) -> None:
        """Start with none."""
        self._run: _Run | None = None

    @property
    def busy(self) -> bool:
        """Whether a run goes on, or its result was not taken yet."""
        return self._run is not None

    def start(self, number: int, tracker: BodyTracker, task: Task, background: Executor | None) -> None:
        """Fit the person `number` by `tracker`, which belongs to the run from now on, on `background` or in line."""
        self._run = _Run(number, tracker, task)
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
