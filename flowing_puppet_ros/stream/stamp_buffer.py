# SPDX-License-Identifier: Apache-2.0
"""Inputs that wait for the partner of the same stamp: a leading input, and others that come sooner or later."""

from __future__ import annotations

from collections import deque
from typing import Any

from flowing_puppet_ros.stream.time_synchronizer import BACKWARD_JUMP_NS


class StampBuffer:
    """Messages of one input by their stamp, the newest `depth` of them."""

    def __init__(self, depth: int = 60) -> None:
        """Keep at most `depth` messages."""
        self._items: dict[int, Any] = {}
        self._depth = depth

    def put(self, stamp: int, item: Any) -> None:
        """Keep `item`; the longest kept one goes when there are too many."""
        self._items.pop(stamp, None)
        self._items[stamp] = item
        if len(self._items) > self._depth:
            del self._items[next(iter(self._items))]

    def get(self, stamp: int) -> Any:
        """Return the item of exactly this stamp, or None."""
        return self._items.get(stamp)

    def drop_until(self, stamp: int) -> int:
        """Drop the items up to and with `stamp` and return how many there were."""
        old = [key for key in self._items if key <= stamp]
        for key in old:
            del self._items[key]
        return len(old)

    def clear(self) -> None:
        """Drop everything."""
        self._items.clear()


class PendingQueue:
    """Items of the leading input in the order they came; the last one that left tells what is late."""

    def __init__(self) -> None:
        """Start empty."""
        self.waiting: deque[tuple[int, Any]] = deque()
        self.left: int | None = None

    def pop(self) -> tuple[int, Any]:
        """Let the first one leave."""
        stamp, item = self.waiting.popleft()
        self.left = stamp
        return stamp, item

    def is_late(self, stamp: int) -> bool:
        """Whether a partner of this stamp comes after its leading item has left (and is no restart)."""
        return self.left is not None and 0 <= self.left - stamp < BACKWARD_JUMP_NS

    def clear(self) -> None:
        """Start again."""
        self.waiting.clear()
        self.left = None
