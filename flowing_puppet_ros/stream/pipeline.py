# SPDX-License-Identifier: Apache-2.0
"""Tasks of several stages on several threads: each stage does its tasks in order, and stages run beside each other."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from threading import Condition, Thread
from types import TracebackType
from typing import Self


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """Work of a `stage`, after that of earlier tasks of the same sequence: `after` are their places in it."""

    stage: Hashable
    work: Callable[[], None]
    after: tuple[int, ...] = ()


@dataclass(slots=True, eq=False)
class _Waiting:
    """A task that is not done: its number, how many tasks it waits for, those that wait for it, and its sequence."""

    number: int
    work: Callable[[], None]
    left: list[int]
    waits: int
    followers: list[_Waiting]
    done: bool = False


class Pipeline:
    """Runs sequences of tasks, used as a context manager; leaving it waits for all of them.

    A task runs when the stage's task before it is done, in whatever sequence that was, and so are the tasks that it
    comes `after`. Nothing else orders them, so a stage must share no state with another one but what is handed on by a
    task that the other one's comes after. Then the results are those of one thread, which does all tasks as they are
    added. What is older goes first. At most `max_sequences` are unfinished: `add` waits.

    An error of a task ends all work; `add` or leaving the context raises it.
    """

    def __init__(self, threads: int, max_sequences: int) -> None:
        """Start the threads; with one, the caller's own does everything."""
        self._max_sequences = max_sequences
        self._state = Condition()
        self._ready: list[tuple[int, _Waiting]] = []
        self._last: dict[Hashable, _Waiting] = {}
        self._number = 0
        self._unfinished = 0
        self._error: BaseException | None = None
        self._closed = False
        count = threads if threads > 1 else 0
        self._threads = [Thread(target=self._serve, name=f"pipeline-{k}", daemon=True) for k in range(count)]
        for thread in self._threads:
            thread.start()

    def add(self, tasks: Sequence[Task]) -> None:
        """Add a sequence of tasks."""
        if not self._threads:
            for task in tasks:
                task.work()
            return
        with self._state:
            self._state.wait_for(lambda: self._error or self._unfinished < self._max_sequences)
            self._raise_error()
            if not tasks:
                return
            self._unfinished += 1
            left, added = [len(tasks)], list[_Waiting]()
            for task in tasks:
                item = _Waiting(self._number, task.work, left, 0, [])
                self._number += 1
                for earlier in (self._last.get(task.stage), *(added[place] for place in task.after)):
                    if earlier is not None and not earlier.done:
                        earlier.followers.append(item)
                        item.waits += 1
                self._last[task.stage] = item
                added.append(item)
            for item in added:
                self._start_if_ready(item)
            self._state.notify_all()

    def _start_if_ready(self, item: _Waiting) -> None:
        if item.waits == 0:
            heapq.heappush(self._ready, (item.number, item))

    def _serve(self) -> None:
        while True:
            with self._state:
                self._state.wait_for(lambda: self._ready or self._closed)
                if self._closed:
                    return
                _, item = heapq.heappop(self._ready)
            try:
                item.work()
            except BaseException as error:
                with self._state:
                    self._error = self._error or error
                    self._closed = True
                    self._state.notify_all()
                return
            with self._state:
                self._finish(item)

    def _finish(self, item: _Waiting) -> None:
        item.done = True
        for follower in item.followers:
            follower.waits -= 1
            self._start_if_ready(follower)
        item.followers, item.work = [], _do_nothing  # the last task of a stage is kept, and should keep nothing
        item.left[0] -= 1
        self._unfinished -= item.left[0] == 0
        self._state.notify_all()

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._state:
            if kind is None:
                self._state.wait_for(lambda: self._error or self._unfinished == 0)
            self._closed = True
            self._state.notify_all()
        for thread in self._threads:
            thread.join()
        if kind is None:
            self._raise_error()


def _do_nothing() -> None:
    """Do nothing."""
