# SPDX-License-Identifier: Apache-2.0
"""One thread that does the work of a node in order of arrival, while the node continues to receive.

Messages wait in bounded queues, one per input. A full queue drops its oldest message for the newest, so a node that
cannot keep up stays near the present instead of falling behind, and a flood on one input drops nothing of another.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable

Task = Callable[[], None]


class Worker:
    """Runs tasks one after the other on its own thread; `limit` is the maximum length of each queue and may change."""

    def __init__(self, limit: int, on_error: Callable[[Exception], None]) -> None:
        """Start the thread; `on_error` is called with what a task raises."""
        self.dropped: Counter[str] = Counter()
        self.limit = limit
        self._on_error = on_error
        self._tasks: deque[tuple[tuple[str, str] | None, Task, int]] = deque()
        self._added = 0
        self._batch = 0
        self._changed = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="worker", daemon=True)
        self._thread.start()

    def is_behind(self) -> bool:
        """Return whether messages of the present batch wait in a bounded queue.

        A batch is what waits when its first task begins. What comes later belongs to the next one, so that a flood of
        messages does not put off the work for ever.
        """
        with self._changed:
            return any(name is not None and number <= self._batch for name, _, number in self._tasks)

    def put(self, queue: str, task: Task, person: str = "") -> None:
        """Append a task to a bounded queue; drop the queue's oldest tasks if it is full.

        On an input that has a topic for each person, each `person` has a queue; what is dropped is counted together.
        """
        with self._changed:
            waiting = [index for index, (name, _, _) in enumerate(self._tasks) if name == (queue, person)]
            for index in reversed(waiting[: max(0, len(waiting) + 1 - self.limit)]):
                del self._tasks[index]
                self.dropped[queue] += 1
            self._append((queue, person), task)
            self._changed.notify()

    def call(self, task: Task) -> None:
        """Append a task that is never dropped."""
        with self._changed:
            self._append(None, task)
            self._changed.notify()

    def _append(self, name: tuple[str, str] | None, task: Task) -> None:
        self._added += 1
        self._tasks.append((name, task, self._added))

    def clear(self) -> None:
        """Drop the messages that wait; keep the tasks given to `call`."""
        with self._changed:
            self._tasks = deque(item for item in self._tasks if item[0] is None)

    def stop(self, timeout: float = 1.0) -> None:
        """Drop the waiting tasks and end the thread; a running task has `timeout` seconds to finish."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._tasks or self._stopping)
                if self._stopping:
                    return
                _, task, number = self._tasks.popleft()
                if number > self._batch:
                    self._batch = self._added
            try:
                task()
            except Exception as error:
                self._on_error(error)
            del task  # a message must not live on until the next one comes
