# SPDX-License-Identifier: Apache-2.0
"""Tasks on a Dask cluster, whose machines see the inputs and the results at the same paths as this one.

Start one with `dask scheduler` and, on every machine, `dask worker tcp://host:8786 --nworkers auto --nthreads 1`.
Anyone who can reach a scheduler can run code on its workers, so keep it in a trusted network.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from flowing_puppet_ros.cli.batch.task import BatchTask, TaskResult, execute
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.extras import import_extra

if TYPE_CHECKING:
    from distributed import Client, Future

CONNECT_TIMEOUT_S = 10.0
MAX_IDLE_S = 60.0  # without any worker
POLL_PERIOD_S = 0.1


def run_on_cluster(tasks: Sequence[BatchTask], address: str) -> Iterator[tuple[int, TaskResult]]:
    """Yield (index, result) as the workers of a Dask scheduler finish the tasks.

    If a worker dies, another one repeats its task. Results that were yielded before an error are finished.

    Raises:
        InputError: if there is no scheduler.
        PuppetError: if the scheduler goes away or has no worker for a minute.
    """
    import_extra("distributed", "cluster", "--scheduler")
    with _connect(address) as client:
        waiting = {client.submit(execute, task, pure=False): index for index, task in enumerate(tasks)}
        try:
            idle_since = time.monotonic()
            while waiting:
                before = len(waiting)
                for future, index in list(waiting.items()):
                    found = _collect_result(future, tasks[index], address)
                    if found is not None:
                        del waiting[future]
                        yield index, found
                if len(waiting) < before or _count_workers(client, address):
                    idle_since = time.monotonic()
                elif time.monotonic() - idle_since > MAX_IDLE_S:
                    raise PuppetError(
                        f"the scheduler at {address} has no workers; start some (dask worker {address}) and run the"
                        " same command again"
                    )
                if len(waiting) == before:
                    time.sleep(POLL_PERIOD_S)
        finally:
            client.cancel(list(waiting))


def _connect(address: str) -> Client:
    import dask
    from distributed import Client

    # If the scheduler is lost, fail with our own message instead of Dask's long wait and traceback.
    dask.config.set({"distributed.comm.retry.count": 0})
    try:
        return Client(address, timeout=CONNECT_TIMEOUT_S)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(f"no Dask scheduler answers at {address}; start one with `dask scheduler`") from error


def _count_workers(client: Client, address: str) -> int:
    if client.status != "running":
        raise PuppetError(f"the scheduler at {address} is gone; start it and run the same command again")
    return len(client.scheduler_info(n_workers=-1)["workers"])


def _collect_result(future: Future, task: BatchTask, address: str) -> TaskResult | None:
    """Return a finished result, or None if it is pending; if its worker is lost, another one computes it again."""
    status = future.status
    if status == "finished":
        try:
            found = future.result(timeout=CONNECT_TIMEOUT_S)
        except TimeoutError:
            return None
        assert isinstance(found, TaskResult)
        return found
    if status == "error":
        error = future.exception()
        return TaskResult({}, f"{task.source} failed on the cluster: {type(error).__name__}: {error}", 1)
    if status == "cancelled":
        raise PuppetError(f"the scheduler at {address} is gone; start it and run the same command again")
    return None
