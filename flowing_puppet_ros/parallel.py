# SPDX-License-Identifier: Apache-2.0
"""Independent pieces of work on a few threads: the results and their order do not depend on how many there are."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

from numba import config


def usable_threads(threads: int) -> int:
    """At most `threads`, the cores that this process may use, and NUMBA_NUM_THREADS, by which workers are told less."""
    return max(1, min(threads, int(config.NUMBA_NUM_THREADS)))


def parallel_map[Item, Result](work: Callable[[Item], Result], items: Iterable[Item], threads: int) -> list[Result]:
    """Return what `work` makes of each item, in the items' order; `work` must not change anything that it shares."""
    if threads == 1:
        return [work(item) for item in items]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, items))
