# SPDX-License-Identifier: Apache-2.0
"""The worker: order of arrival, bounded lines that drop the oldest, errors that do not end it."""

import threading

from flowing_puppet_ros.node.worker import Worker


def held_worker(limit: int, errors: list[Exception]) -> tuple[Worker, threading.Event]:
    """Return a worker that is busy until the event is set."""
    worker, gate, busy = Worker(limit, errors.append), threading.Event(), threading.Event()

    def hold() -> None:
        busy.set()
        gate.wait()

    worker.call(hold)
    busy.wait()
    return worker, gate


def finish(worker: Worker, gate: threading.Event) -> None:
    """Let the worker do what waits, then end it."""
    done = threading.Event()
    worker.call(done.set)
    gate.set()
    assert done.wait(10)
    worker.stop()


def test_a_full_line_drops_its_oldest_and_keeps_the_order() -> None:
    seen: list[str] = []
    worker, gate = held_worker(2, [])
    for name in ("a1", "b1", "a2", "a3", "a4", "b2"):
        worker.put(name[0], lambda name=name: seen.append(name))  # type: ignore[misc]
    finish(worker, gate)
    assert seen == ["b1", "a3", "a4", "b2"]
    assert worker.dropped == {"a": 2}


def test_calls_are_never_dropped_and_survive_a_clear() -> None:
    seen: list[str] = []
    worker, gate = held_worker(1, [])
    worker.put("a", lambda: seen.append("a"))
    for number in range(3):
        worker.call(lambda number=number: seen.append(f"call {number}"))  # type: ignore[misc]
    worker.clear()
    worker.put("a", lambda: seen.append("later"))
    finish(worker, gate)
    assert seen == ["call 0", "call 1", "call 2", "later"]


def test_an_error_is_reported_and_the_work_goes_on() -> None:
    errors: list[Exception] = []
    seen: list[int] = []
    worker, gate = held_worker(5, errors)
    worker.put("a", lambda: seen.append(1 // 0))
    worker.put("a", lambda: seen.append(2))
    finish(worker, gate)
    assert seen == [2]
    assert [type(error) for error in errors] == [ZeroDivisionError]


def test_only_what_waited_when_a_batch_began_is_behind() -> None:
    seen: list[tuple[str, bool]] = []
    worker, gate = held_worker(9, [])

    def note(name: str, then: str = "") -> None:
        if then:
            worker.put("a", lambda: note(then))
        seen.append((name, worker.is_behind()))

    worker.put("a", lambda: note("first", "later"))
    worker.put("b", lambda: note("second"))
    worker.put("a", lambda: note("third"))
    done = threading.Event()
    worker.put("c", lambda: note("last"))
    worker.call(lambda: worker.put("c", done.set))
    gate.set()
    assert done.wait(10)
    worker.stop()
    # "later" waits already while "last" is done, which ends the batch, and begins the next one.
    assert seen == [("first", True), ("second", True), ("third", True), ("last", False), ("later", True)]
