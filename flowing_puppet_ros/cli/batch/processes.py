# SPDX-License-Identifier: Apache-2.0
"""Tasks in processes of this machine, which share its cores; a process that dies takes no other task with it."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess

from flowing_puppet_ros.cli.batch.task import Answer, Task, answer
from flowing_puppet_ros.parallel import usable_threads

# What tells the libraries how many threads to start; it is read when they are imported.
THREADS = (
    *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"),
    *("NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"),
)
MOST_THREADS = 1024
TRIES = 2


@dataclass(slots=True, eq=False)
class _Worker:
    process: SpawnProcess
    index: int


def in_processes(tasks: Sequence[Task], workers: int) -> Iterator[tuple[int, Answer]]:
    """Yield (index, answer) as tasks are done in `workers` processes, each with its share of the cores.

    A task whose process dies (killed, out of memory) is tried once more in a new one before it counts as failed.
    """
    share = max(1, usable_threads(MOST_THREADS) // workers)
    waiting = deque(range(len(tasks)))
    tries = [0] * len(tasks)
    running: dict[Connection, _Worker] = {}
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                pipe, process = _started(share)
                running[pipe] = _Worker(process, -1)
                _give(pipe, running[pipe], waiting, tries, tasks)
            for ready in wait(list(running)):
                assert isinstance(ready, Connection)
                pipe = ready
                worker = running[pipe]
                try:
                    found = pipe.recv()
                except (EOFError, OSError):
                    _end(pipe, running)
                    if tries[worker.index] < TRIES:
                        waiting.appendleft(worker.index)
                    else:
                        yield worker.index, _died(tasks[worker.index], worker.process)
                    continue
                index = worker.index
                if waiting:
                    _give(pipe, worker, waiting, tries, tasks)
                else:
                    _end(pipe, running)
                yield index, found
    finally:
        for pipe in list(running):
            running[pipe].process.terminate()
            _end(pipe, running)


def _give(pipe: Connection, worker: _Worker, waiting: deque[int], tries: list[int], tasks: Sequence[Task]) -> None:
    worker.index = waiting.popleft()
    tries[worker.index] += 1
    with suppress(OSError):  # when it is dead already reading from it tells
        pipe.send(tasks[worker.index])


def _end(pipe: Connection, running: dict[Connection, _Worker]) -> None:
    """Close a pipe, which ends its process, and wait for that."""
    worker = running.pop(pipe)
    pipe.close()
    worker.process.join()


def _died(task: Task, process: SpawnProcess) -> Answer:
    code = process.exitcode or 0
    how = f"by signal {-code}" if code < 0 else f"with status {code}"
    return Answer({}, f"{task.source} failed: its process ended {how} {TRIES} times; memory may be short", 1)


def _started(share: int) -> tuple[Connection, SpawnProcess]:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs,), daemon=True)
    with _environment(dict.fromkeys(THREADS, str(share))):
        process.start()
    theirs.close()
    return ours, process


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _serve(pipe: Connection) -> None:
    """Answer tasks until the pipe is closed; an interrupt is the parent's to handle."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        while True:
            pipe.send(answer(pipe.recv()))
    except (EOFError, OSError):
        return
