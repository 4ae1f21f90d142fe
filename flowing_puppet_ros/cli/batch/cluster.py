# SPDX-License-Identifier: Apache-2.0
"""Tasks on a Dask cluster, whose machines see the inputs and the results at the same paths as this one.

`dask scheduler` and, on every machine, `dask worker tcp://host:8786 --nworkers auto --nthreads 1` make one. Whoever can
reach a scheduler can run code on its workers, so keep it in a network that you trust.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from flowing_puppet_ros.cli.batch.task import Answer, Task, answer
from flowing_puppet_ros.errors import InputError, PuppetError

if TYPE_CHECKING:
    from distributed import Client, Future

REACH_SECONDS = 10.0
IDLE_SECONDS = 60.0
POLL_SECONDS = 0.1


def on_cluster(tasks: Sequence[Task], address: str) -> Iterator[tuple[int, Answer]]:
    """Yield (index, answer) as the workers of a Dask scheduler do the tasks.

    A task whose worker dies is done by another one. Raises InputError when there is no scheduler, PuppetError when the
    scheduler goes away or has no worker for a minute; what was yielded until then is finished.
    """
    try:
        import distributed  # noqa: F401
    except ImportError as error:
        raise InputError("--scheduler needs Dask: pip install 'flowing_puppet_ros[cluster]'") from error
    with _connected(address) as client:
        waiting = {client.submit(answer, task, pure=False): index for index, task in enumerate(tasks)}
        try:
            idle_since = time.monotonic()
            while waiting:
                before = len(waiting)
                for future, index in list(waiting.items()):
                    found = _answer(future, tasks[index], address)
                    if found is not None:
                        del waiting[future]
                        yield index, found
                if len(waiting) < before or _workers(client, address):
                    idle_since = time.monotonic()
                elif time.monotonic() - idle_since > IDLE_SECONDS:
                    raise PuppetError(
                        f"the scheduler at {address} has no workers; start some (dask worker {address}) and run the"
                        " same command again"
                    )
                if len(waiting) == before:
                    time.sleep(POLL_SECONDS)
        finally:
            client.cancel(list(waiting))


def _connected(address: str) -> Client:
    import dask
    from distributed import Client

    # A lost scheduler ends the work in a sentence of ours instead of a long wait and a traceback of the library's.
    dask.config.set({"distributed.comm.retry.count": 0})
    try:
        return Client(address, timeout=REACH_SECONDS)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(f"no Dask scheduler answers at {address}; start one with `dask scheduler`") from error


def _workers(client: Client, address: str) -> int:
    if client.status != "running":
        raise PuppetError(f"the scheduler at {address} is gone; start it and run the same command again")
    return len(client.scheduler_info(n_workers=-1)["workers"])


def _answer(future: Future, task: Task, address: str) -> Answer | None:
    """What came back, None when nothing did yet: a result that died with its worker is awaited from another one."""
    status = future.status
    if status == "finished":
        try:
            found = future.result(timeout=REACH_SECONDS)
        except TimeoutError:
            return None
        assert isinstance(found, Answer)
        return found
    if status == "error":
        error = future.exception()
        return Answer({}, f"{task.source} failed on the cluster: {type(error).__name__}: {error}", 1)
    if status == "cancelled":
        raise PuppetError(f"the scheduler at {address} is gone; start it and run the same command again")
    return None
