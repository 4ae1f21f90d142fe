# SPDX-License-Identifier: Apache-2.0
"""Synchronisation of several inputs by their stamps, in whatever order they arrive."""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from typing import Any

BACKWARD_JUMP_NS = 100_000_000
"""Nanoseconds; a stamp this much before its predecessor on the same input is a restart, not disorder."""


class _Queue:
    """Items of one input that wait for their partners, in the order of their stamps."""

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.items: list[Any] = []
        self.last_stamp: int | None = None

    def drop(self, count: int) -> None:
        del self.stamps[:count]
        del self.items[:count]

    def drop_after(self, stamp: int) -> int:
        keep = bisect_left(self.stamps, stamp + 1)
        dropped = len(self.stamps) - keep
        del self.stamps[keep:]
        del self.items[keep:]
        return dropped

    def find_nearest(self, stamp: int, final: bool) -> int | None:
        """Return the index of the item nearest to `stamp` (the earlier on a tie); None while a nearer one may come."""
        after = bisect_left(self.stamps, stamp)
        if after == len(self.stamps):
            return after - 1 if final else None
        if after and stamp - self.stamps[after - 1] <= self.stamps[after] - stamp:
            return after - 1
        return after

    def is_near(self, index: int, stamp: int, slop: int) -> bool:
        return index >= 0 and abs(self.stamps[index] - stamp) <= slop


class TimeSynchronizer:
    """Makes sets of one item from each input.

    The first input leads: each of its items is joined with the nearest item of every other input, if all lie within
    `slop_ns`. No item is used twice, and sets come in the order of their stamps. A set is made as soon as no later
    message can change it, so the sets do not depend on how the inputs interleave while at most `depth` items of each
    input wait. `counters` has what found no partner: `unpaired` (its partners came, but were too far away or used
    up), `dropped` (more than `depth` items waited), `disordered` (stamp not after the previous one of the same
    input), `restarts` (stamp more than BACKWARD_JUMP_NS back: everything later is dropped).

    With `patience` > 0, sets of at least `min_items` are made without the inputs that have no item near enough
    (counted in `incomplete`): as soon as that is certain, or when more than `patience` items of the leading input
    wait. While the inputs before it have no items, the first input that has some leads.
    """

    def __init__(
        self, names: tuple[str, ...], slop_ns: int = 0, depth: int = 60, patience: int = 0, min_items: int = 2
    ) -> None:
        """Synchronise the inputs `names`, of which the first leads; without `patience` every set is complete."""
        self._queues = {name: _Queue() for name in names}
        self._leader = names[0]
        self._patience, self._min_items = patience, min(min_items, len(names))
        self._slop = slop_ns
        self._depth = depth
        self.counters: Counter[str] = Counter()

    def add(self, name: str, stamp: int, item: Any) -> list[dict[str, tuple[int, Any]]]:
        """Add one item and return the sets, name -> (stamp, item), that are now ready."""
        queue = self._queues[name]
        if queue.last_stamp is not None and stamp <= queue.last_stamp:
            if queue.last_stamp - stamp < BACKWARD_JUMP_NS:
                self.counters["disordered"] += 1
                return []
            self.counters["restarts"] += 1
            for other in self._queues.values():
                self.counters["unpaired"] += other.drop_after(stamp + BACKWARD_JUMP_NS)
        queue.last_stamp = stamp
        queue.stamps.append(stamp)
        queue.items.append(item)
        sets = self._pop_sets(final=False)
        if len(queue.stamps) > self._depth:
            queue.drop(1)
            self.counters["dropped"] += 1
        return sets

    def flush(self) -> list[dict[str, tuple[int, Any]]]:
        """Return the sets of the waiting items as if the input had ended; drop the rest."""
        sets = self._pop_sets(final=True)
        for queue in self._queues.values():
            self.counters["unpaired"] += queue.drop_after(-1)
        return sets

    def reset(self) -> None:
        """Drop everything that waits."""
        self._queues = {name: _Queue() for name in self._queues}

    def _pop_sets(self, final: bool) -> list[dict[str, tuple[int, Any]]]:
        sets: list[dict[str, tuple[int, Any]]] = []
        while (leader := self._choose_leader(final)) is not None:
            stamp = leader.stamps[0]
            impatient = 0 < self._patience < len(leader.stamps)
            indices: dict[str, int] = {}
            for name, queue in self._queues.items():
                index = queue.find_nearest(stamp, final or impatient)
                if index is None:
                    return sets
                if queue.is_near(index, stamp, self._slop):
                    indices[name] = index
            if len(indices) < (self._min_items if self._patience else len(self._queues)):
                leader.drop(1)
                self.counters["unpaired"] += 1
                continue
            if len(indices) < len(self._queues):
                self.counters["incomplete"] += 1
            sets.append({name: (self._queues[name].stamps[at], self._queues[name].items[at])
                         for name, at in indices.items()})  # fmt: skip
            for name, index in indices.items():
                self.counters["unpaired"] += index
                self._queues[name].drop(index + 1)
        return sets

    def _choose_leader(self, final: bool) -> _Queue | None:
        """Return the input whose first item leads the next set; None while there is nothing to do."""
        first = self._queues[self._leader]
        if first.stamps or not self._patience:
            return first if first.stamps else None
        min_items = 1 if final else self._patience + 1
        return next((queue for queue in self._queues.values() if len(queue.stamps) >= min_items), None)
