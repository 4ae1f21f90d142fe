# SPDX-License-Identifier: Apache-2.0
"""Tasks in local processes that share the cores; a process that dies does not affect other tasks."""

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

from flowing_puppet_ros.cli.batch.task import BatchTask, TaskResult, execute
from flowing_puppet_ros.process.threads import MAX_THREADS, usable_threads

# Environment variables that set the libraries' numbers of threads; read when the libraries are imported.
THREAD_VARIABLES = (
    *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"),
    *("NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"),
)
MAX_TRIES = 2  # of a task whose process dies


@dataclass(slots=True, eq=False)
class _Worker:
    process: SpawnProcess
    index: int


def run_in_processes(tasks: Sequence[BatchTask], workers: int) -> Iterator[tuple[int, TaskResult]]:
    """Yield (index, result) as tasks finish in `workers` processes, each with its share of the cores.

    A task whose process dies (killed, out of memory) is tried once more in a new process before it counts as failed.
    """
    share = max(1, usable_threads(MAX_THREADS) // workers)
    waiting = deque(range(len(tasks)))
    tries = [0] * len(tasks)
    running: dict[Connection, _Worker] = {}
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                pipe, process = _start(share)
                running[pipe] = _Worker(process, -1)
                _assign(pipe, running[pipe], waiting, tries, tasks)
            for ready in wait(list(running)):
                assert isinstance(ready, Connection)
                pipe = ready
                worker = running[pipe]
                try:
                    found = pipe.recv()
                except (EOFError, OSError):
                    _close(pipe, running)
                    if tries[worker.index] < MAX_TRIES:
                        waiting.appendleft(worker.index)
                    else:
                        yield worker.index, _describe_death(tasks[worker.index], worker.process)
                    continue
                index = worker.index
                if waiting:
                    _assign(pipe, worker, waiting, tries, tasks)
                else:
                    _close(pipe, running)
                yield index, found
    finally:
        for pipe in list(running):
            running[pipe].process.terminate()
            _close(pipe, running)


def _assign(
    pipe: Connection, worker: _Worker, waiting: deque[int], tries: list[int], tasks: Sequence[BatchTask]
) -> None:
    worker.index = waiting.popleft()
    tries[worker.index] += 1
    with suppress(OSError):  # if it is already dead, reading from it shows that
        pipe.send(tasks[worker.index])


def _close(pipe: Connection, running: dict[Connection, _Worker]) -> None:
    """Close a pipe, which ends its process, and join the process."""
    worker = running.pop(pipe)
    pipe.close()
    worker.process.join()


def _describe_death(task: BatchTask, process: SpawnProcess) -> TaskResult:
    code = process.exitcode or 0
    how = f"by signal {-code}" if code < 0 else f"with status {code}"
    return TaskResult({}, f"{task.source} failed: its process ended {how} {MAX_TRIES} times; memory may be short", 1)


def _start(share: int) -> tuple[Connection, SpawnProcess]:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs,), daemon=True)
    with _set_environment(dict.fromkeys(THREAD_VARIABLES, str(share))):
        process.start()
    theirs.close()
    return ours, process


@contextmanager
def _set_environment(values: dict[str, str]) -> Iterator[None]:
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
    """Execute tasks until the pipe is closed; interrupts are left to the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        while True:
            pipe.send(execute(pipe.recv()))
    except (EOFError, OSError):
        return
