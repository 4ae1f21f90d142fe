# SPDX-License-Identifier: Apache-2.0
"""Tasks of several stages on threads: the order within a stage, what comes after what, the bound, and errors."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from flowing_puppet_ros.stream.pipeline import Pipeline, Task

WAIT_S = 20.0  # for what must happen


def run_sequences(threads: int) -> tuple[list[tuple[str, int]], dict[str, list[float]]]:
    """Run three stages, of which each hands a number on to the next, and return the order and the results."""
    rng = np.random.default_rng(1)
    pauses = rng.random((30, 3)) * 0.003
    order: list[tuple[str, int]] = []
    results: dict[str, list[float]] = {"a": [], "b": [], "c": []}
    state = dict.fromkeys(results, 0.0)

    def work(name: str, number: int, given: list[float], pause: float) -> None:
        threading.Event().wait(pause)
        state[name] = 0.5 * state[name] + sum(given) + number
        given.append(state[name])
        results[name].append(state[name])
        order.append((name, number))

    with Pipeline(threads, max_sequences=6) as pipeline:
        for number in range(30):
            given = [1.0]
            names = "abc" if number % 3 else "ac"
            pipeline.add(
                [
                    Task(name, partial(work, name, number, given, pauses[number, k]), (k - 1,) if k else ())
                    for k, name in enumerate(names)
                ]
            )
    return order, results


@pytest.mark.parametrize("threads", [2, 5])
def test_results_are_those_of_one_thread(threads: int) -> None:
    """Every stage mixes its own past with what it is given: another order anywhere gives other numbers."""
    order, results = run_sequences(threads)
    in_turn, expected = run_sequences(1)
    assert in_turn == sorted(in_turn, key=lambda item: (item[1], item[0]))
    assert results == expected
    assert order != in_turn, "stages run beside each other"


def test_stages_run_at_the_same_time() -> None:
    meeting = threading.Barrier(2, timeout=WAIT_S)

    def meet() -> None:
        meeting.wait()

    with Pipeline(2, max_sequences=4) as pipeline:
        pipeline.add([Task("a", meet), Task("b", meet)])
        pipeline.add([Task("a", meet)])
        pipeline.add([Task("b", meet)])
    assert not meeting.broken


def test_adding_waits_while_too_much_is_unfinished() -> None:
    gate, begun = threading.Event(), threading.Event()

    def hold() -> None:
        begun.set()
        gate.wait(WAIT_S)

    with Pipeline(2, max_sequences=2) as pipeline:
        pipeline.add([Task("a", hold)])
        pipeline.add([Task("a", _do_nothing)])
        third = threading.Thread(target=pipeline.add, args=([Task("a", _do_nothing)],))
        third.start()
        assert begun.wait(WAIT_S)
        third.join(0.2)
        assert third.is_alive()
        gate.set()
        third.join(WAIT_S)
        assert not third.is_alive()


@pytest.mark.parametrize("threads", [1, 3])
def test_an_error_ends_the_work_and_is_raised(threads: int) -> None:
    done: list[int] = []

    def fail() -> None:
        raise KeyError("the third")

    def make(number: int) -> Callable[[], None]:
        return fail if number == 3 else partial(done.append, number)

    with pytest.raises(KeyError, match="the third"), Pipeline(threads, max_sequences=5) as pipeline:
        for number in range(1000):
            pipeline.add([Task("a", make(number))])
    assert done == [0, 1, 2]


def test_leaving_after_an_error_of_the_caller_waits_for_nothing() -> None:
    done: list[int] = []
    gate = threading.Event()

    def leave(pipeline: Pipeline) -> None:
        with pipeline:
            pipeline.add([Task("a", partial(_wait_for, gate)), Task("b", partial(done.append, 1), (0,))])
            gate.set()
            raise ValueError("of the caller")

    with pytest.raises(ValueError, match="of the caller"):
        leave(Pipeline(2, max_sequences=5))
    before = threading.active_count()
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("pipeline-")], before


def _do_nothing() -> None:
    """Do nothing."""


def _wait_for(gate: threading.Event) -> None:
    """Wait until the gate is open."""
    assert gate.wait(WAIT_S)
