# SPDX-License-Identifier: Apache-2.0
"""Memory that a process keeps: few heaps for its threads, and none of what only its start needed."""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

_M_ARENA_MAX = -8  # of mallopt(3), from glibc's malloc.h
_MADV_DONTNEED = 4  # of madvise(2), from Linux's mman-common.h
_SMAPS = Path("/proc/self/smaps")
MAX_ARENAS = 2
"""Heaps of the C library. It makes eight for every core otherwise, and each keeps what its threads once needed."""
MIN_RESIDENT_KB = 1024
"""Pages of a library in memory from which on it is worth the call to give them back."""


def limit_arenas() -> None:
    """Let threads share the C library's heaps; call it before there are any. Nothing happens without glibc."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, MAX_ARENAS)


def return_start_memory() -> None:
    """Return freed memory to the system, and what is in memory of libraries because the start needed it.

    A compiler's 75 MB are most of the latter. What is needed again comes back from the file, a page at a time. Only
    Linux with glibc is asked to.
    """
    gc.collect()
    library = ctypes.CDLL(None)
    malloc_trim, madvise = getattr(library, "malloc_trim", None), getattr(library, "madvise", None)
    if malloc_trim is not None:
        malloc_trim(0)
    if madvise is not None:
        with suppress(OSError):
            for start, size in list(find_unchanged(_SMAPS.read_text())):
                madvise(ctypes.c_void_p(start), ctypes.c_size_t(size), _MADV_DONTNEED)


def find_unchanged(smaps: str) -> Iterator[tuple[int, int]]:
    """Yield address and size in bytes of the mappings of libraries in /proc/PID/smaps that are as in their files.

    Nobody can write to them, and nobody has: pages that the loader changed before it forbade that are anonymous.
    """
    start = end = resident = 0
    for line in smaps.splitlines():
        words = line.split()
        if not words[0].endswith(":"):
            is_library = len(words) > 5 and ".so" in words[5] and words[1] in ("r-xp", "r--p")
            start, end = (int(side, 16) for side in words[0].split("-")) if is_library else (0, 0)
        elif words[0] == "Rss:":
            resident = int(words[1])
        elif words[0] == "Anonymous:" and end > start and int(words[1]) == 0 and resident >= MIN_RESIDENT_KB:
            yield start, end - start
