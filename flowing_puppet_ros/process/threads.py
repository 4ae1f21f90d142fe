# SPDX-License-Identifier: Apache-2.0
"""Threads: independent work on several, and BLAS and OpenCV on one where the number of threads changes the result.

`one_blas_thread` and `one_opencv_thread` limit the whole process, since neither library counts by caller. They nest,
may be entered from several threads at once, and give the former count back when the last caller has left.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache, partial
from threading import Lock

import threadpoolctl

MAX_THREADS = 1024  # more than any machine has cores


def usable_threads(threads: int) -> int:
    """Return at most `threads`, the cores that this process may use, and NUMBA_NUM_THREADS, which limits workers."""
    from numba import config  # loaded here: who only parses arguments has no use for a compiler

    return max(1, min(threads, int(config.NUMBA_NUM_THREADS)))


def parallel_map[Item, Result](work: Callable[[Item], Result], items: Iterable[Item], threads: int) -> list[Result]:
    """Apply `work` to each item and return the results in the items' order; `work` must not change shared state.

    The results and their order do not depend on the number of threads.
    """
    items = list(items)
    if threads == 1 or len(items) < 2:
        return [work(item) for item in items]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, items))


type Restore = Callable[[], None]
"""Gives a library its former number of threads back."""


class _SharedLimit:
    """A limit of one thread that holds while any caller is inside.

    `limit` sets one thread and returns how to undo that, or None when there was one already. It runs at every entry:
    someone may have raised the count since the first caller entered.
    """

    def __init__(self, limit: Callable[[], Restore | None]) -> None:
        self._limit = limit
        self._lock = Lock()
        self._callers = 0
        self._restores: list[Restore] = []

    @contextmanager
    def hold(self) -> Iterator[None]:
        """Limit the library until the last caller leaves."""
        with self._lock:
            if (restore := self._limit()) is not None:
                self._restores.append(restore)
            self._callers += 1
        try:
            yield
        finally:
            with self._lock:
                self._callers -= 1
                while self._callers == 0 and self._restores:
                    self._restores.pop(0)()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let numpy and scipy multiply matrices with one thread inside the context."""
    with _BLAS.hold():
        yield


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """Let OpenCV work with one thread inside the context."""
    with _OPENCV.hold():
        yield


def _limit_blas() -> Restore | None:
    # Only what is changed is given back: what another caller limited for the whole process is theirs to give back.
    former = [
        (library, count)
        for library in _find_libraries("scipy.linalg" in sys.modules)
        if (count := library.get_num_threads()) > 1
    ]
    if not former:
        return None

    def set_counts(counts: Iterable[tuple[threadpoolctl.LibController, int]]) -> None:
        _disown_openblas()
        for library, count in counts:
            library.set_num_threads(count)
        _disown_openblas()

    set_counts((library, 1) for library, _ in former)
    return partial(set_counts, former)


def _disown_openblas() -> None:
    """Let any thread limit OpenBLAS: threadpoolctl 3.8 silently ignores all but the first thread that does."""
    clear = getattr(threadpoolctl.OpenBLASController, "clear_controlling_thread", None)
    if clear is not None:
        clear(force=True)


def _limit_opencv() -> Restore | None:
    # Loaded here: bodies need the other functions of this module, and no OpenCV.
    import cv2

    former = cv2.getNumThreads()
    if former == 1:
        return None
    cv2.setNumThreads(1)
    return partial(cv2.setNumThreads, former)


@cache
def _find_libraries(_with_scipy: bool) -> tuple[threadpoolctl.LibController, ...]:
    # To look for the libraries takes milliseconds; done again once SciPy, which brings a BLAS of its own, is loaded.
    return tuple(threadpoolctl.ThreadpoolController().lib_controllers)


_BLAS, _OPENCV = _SharedLimit(_limit_blas), _SharedLimit(_limit_opencv)
