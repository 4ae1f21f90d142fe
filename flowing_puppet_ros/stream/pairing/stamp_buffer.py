# SPDX-License-Identifier: Apache-2.0
"""Buffers of inputs that wait for a partner of the same stamp: a leading input, and others before or after it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from flowing_puppet_ros.stream.pairing.time_synchronizer import BACKWARD_JUMP_NS


class StampBuffer:
    """The newest `depth` messages of one input, by stamp (nanoseconds)."""

    def __init__(self, depth: int = 60) -> None:
        """Make an empty buffer of at most `depth` messages."""
        self._items: dict[int, Any] = {}
        self._depth = depth

    def put(self, stamp: int, item: Any) -> None:
        """Store `item`; drop the oldest one when the buffer is full."""
        self._items.pop(stamp, None)
        self._items[stamp] = item
        if len(self._items) > self._depth:
            del self._items[next(iter(self._items))]

    def get(self, stamp: int) -> Any:
        """Return the item of exactly this stamp, or None."""
        return self._items.get(stamp)

    def drop_until(self, stamp: int) -> int:
        """Drop the items up to and including `stamp`; return how many there were."""
        old = [key for key in self._items if key <= stamp]
        for key in old:
            del self._items[key]
        return len(old)

    def clear(self) -> None:
        """Drop everything."""
        self._items.clear()


class PendingQueue:
    """Items of the leading input in order of arrival; what is late follows from the stamp popped last."""

    def __init__(self) -> None:
        """Make an empty queue."""
        self.waiting: deque[tuple[int, Any]] = deque()
        self.last_popped: int | None = None

    def pop(self) -> tuple[int, Any]:
        """Remove and return the first (stamp, item)."""
        stamp, item = self.waiting.popleft()
        self.last_popped = stamp
        return stamp, item

    def is_late(self, stamp: int) -> bool:
        """Return whether a partner of this stamp comes after its leading item was popped (and is not a restart)."""
        return self.last_popped is not None and 0 <= self.last_popped - stamp < BACKWARD_JUMP_NS

    def clear(self) -> None:
        """Drop everything."""
        self.waiting.clear()
        self.last_popped = None


class CloudLine(PendingQueue):
    """Clouds in order of arrival, which wait for what belongs to them.

    Whoever falls behind goes on with the newest cloud that has everything; those before it are dropped.
    """

    def __init__(self, drop: Callable[[Any], None]) -> None:
        """Make an empty line; `drop` is told of every item that is dropped for a newer one."""
        super().__init__()
        self._drop = drop
        self.clear()

    def clear(self) -> None:
        """Drop everything, and be up to date."""
        super().clear()
        self.first: int | None = None
        self.is_behind = False

    def append(self, stamp: int, item: Any, limit: int | None = None) -> None:
        """Let an item wait; where there are more than `limit` (3 or more), drop items where they are densest.

        If the oldest were dropped instead, a partner that is always late would never find its item.
        """
        self.first = stamp if self.first is None else min(self.first, stamp)
        self.waiting.append((stamp, item))
        while limit is not None and len(self.waiting) > limit:
            stamps = [each for each, _ in self.waiting]
            gaps = [later - earlier for earlier, later in zip(stamps, stamps[2:], strict=False)]
            index = 1 + gaps.index(min(gaps))
            self._drop(self.waiting[index][1])
            del self.waiting[index]

    def take(self, is_ready: Callable[[int], bool]) -> tuple[int, Any] | None:
        """Remove and return the first (stamp, item) if it has everything; the newest that has if we are behind.

        `is_ready` tells of the item at an index whether it has everything.
        """
        if self.is_behind:
            newest = next((index for index in reversed(range(len(self.waiting))) if is_ready(index)), None)
            if newest is None:
                return None
            self.is_behind = False
            for _ in range(newest):
                self._drop(self.pop()[1])
        elif not self.waiting or not is_ready(0):
            return None
        return self.pop()
