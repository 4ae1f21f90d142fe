# SPDX-License-Identifier: Apache-2.0
"""Pairing by stamps: against a brute-force reference, in any interleaving, over restarts, in bounded memory."""

from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowing_puppet_ros.stream.pairing.time_synchronizer import BACKWARD_JUMP_NS, TimeSynchronizer

SLOP = 5
stamps = st.lists(st.integers(0, 200), unique=True, max_size=25).map(sorted)


def reference(streams: list[list[int]], slop: int) -> list[tuple[int, ...]]:
    """Every leading stamp with the nearest unused one of each other stream, all streams known in full."""
    used = [-1] * len(streams)
    sets = []
    for lead in streams[0]:
        choice = []
        for k, stream in enumerate(streams):
            left = [s for s in stream if s > used[k]]
            if not left:
                break
            choice.append(min(left, key=lambda s: (abs(s - lead), s)))
        if len(choice) == len(streams) and all(abs(s - lead) <= slop for s in choice):
            sets.append(tuple(choice))
            used = choice
    return sets


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(st.lists(stamps, min_size=2, max_size=3), st.randoms(use_true_random=False))
def test_sets_are_those_of_the_reference_in_every_interleaving(streams: Any, random: Any) -> None:
    names = tuple("abc"[: len(streams)])
    pairing = TimeSynchronizer(names, SLOP)
    left = {name: list(stream) for name, stream in zip(names, streams, strict=True)}
    sets = []
    while any(left.values()):
        name = random.choice([name for name in names if left[name]])
        stamp = left[name].pop(0)
        sets += pairing.add(name, stamp, (name, stamp))
    sets += pairing.flush()
    assert [tuple(each[name][0] for name in names) for each in sets] == reference(streams, SLOP)
    assert all(each[name][1] == (name, each[name][0]) for each in sets for name in names)
    assert all(a[name][0] < b[name][0] for a, b in pairwise(sets) for name in names)
    assert pairing.counters["unpaired"] == sum(map(len, streams)) - len(sets) * len(names)


def test_an_exact_set_is_made_at_once() -> None:
    pairing = TimeSynchronizer(("image", "labels"))
    assert pairing.add("image", 7, "i") == []
    assert pairing.add("labels", 7, "l") == [{"image": (7, "i"), "labels": (7, "l")}]


def test_nearest_waits_until_nothing_nearer_can_come() -> None:
    pairing = TimeSynchronizer(("a", "b"), slop_ns=10)
    pairing.add("b", 93, "early")
    assert pairing.add("a", 100, "lead") == []
    assert [each["b"] for each in pairing.add("b", 104, "late")] == [(104, "late")]


def test_a_recording_that_starts_again_pairs_again() -> None:
    pairing = TimeSynchronizer(("a", "b"), slop_ns=1)
    second = 10 * BACKWARD_JUMP_NS
    found = []
    for stamps_of_loop in ((0, second), (0, second)):
        for stamp in stamps_of_loop:
            found += pairing.add("a", stamp, None)
            found += pairing.add("b", stamp, None)
    assert [each["a"][0] for each in found] == [0, second, 0, second]
    assert pairing.counters["restarts"] == 2


def test_slightly_disordered_and_repeated_stamps_are_left_out() -> None:
    pairing = TimeSynchronizer(("a", "b"))
    for stamp in (1000, 1000, 999):
        pairing.add("a", stamp, stamp)
    assert pairing.counters["disordered"] == 2
    assert pairing.add("b", 1000, "b") == [{"a": (1000, 1000), "b": (1000, "b")}]


@pytest.mark.parametrize("depth", [1, 4])
def test_memory_is_bounded_and_the_newest_are_kept(depth: Any) -> None:
    pairing = TimeSynchronizer(("a", "b"), depth=depth)
    for stamp in range(100):
        pairing.add("a", stamp, stamp)
    assert pairing.counters["dropped"] == 100 - depth
    assert pairing.add("b", 98, "b") == ([] if depth == 1 else [{"a": (98, 98), "b": (98, "b")}])
    assert pairing.add("b", 99, "b") == [{"a": (99, 99), "b": (99, "b")}]


def test_reset_forgets_what_waits() -> None:
    pairing = TimeSynchronizer(("a", "b"))
    pairing.add("a", 5, "old")
    pairing.reset()
    assert pairing.add("b", 5, "new") == []


def feed(pairing: TimeSynchronizer, streams: dict[str, list[int]]) -> list[dict[str, int]]:
    """Add the stamps of all inputs in their order, and return the sets' stamps."""
    entries = sorted((stamp, name) for name, stream in streams.items() for stamp in stream)
    made = [each for stamp, name in entries for each in pairing.add(name, stamp, None)]
    return [{name: stamp for name, (stamp, _) in each.items()} for each in made + pairing.flush()]


def test_with_patience_sets_go_on_without_an_input_that_died() -> None:
    whole, short = list(range(0, 100, 10)), [0, 10, 20]
    pairing = TimeSynchronizer(("a", "b", "c"), SLOP, patience=2)
    sets = feed(pairing, {"a": whole, "b": whole, "c": short})
    assert sets == [{"a": t, "b": t, "c": t} if t <= 20 else {"a": t, "b": t} for t in whole]
    assert pairing.counters["incomplete"] == 7
    sets = feed(TimeSynchronizer(("a", "b", "c"), SLOP, patience=2), {"a": short, "b": whole, "c": whole})
    assert sets == [{"a": t, "b": t, "c": t} if t <= 20 else {"b": t, "c": t} for t in whole]
    assert len(feed(TimeSynchronizer(("a", "b", "c"), SLOP), {"a": whole, "b": whole, "c": short})) == 3


def test_with_patience_a_lone_item_is_no_set_and_a_late_one_is_waited_for() -> None:
    pairing = TimeSynchronizer(("a", "b", "c"), SLOP, patience=3)
    assert feed(pairing, {"a": [0, 10, 20, 30, 40, 50]}) == []
    assert pairing.counters["unpaired"] == 6
    pairing = TimeSynchronizer(("a", "b", "c"), SLOP, patience=3)
    for stamp in (0, 10, 20):
        assert pairing.add("a", stamp, None) == pairing.add("b", stamp, None) == []
    assert [set(each) for each in pairing.add("c", 0, None)] == [{"a", "b", "c"}]


@settings(max_examples=100, deadline=None)
@given(stamps, st.integers(2, 3), st.randoms(use_true_random=False))
def test_patience_changes_nothing_when_nothing_is_missing(stream: list[int], count: int, random: Any) -> None:
    names = tuple("abc"[:count])
    found = []
    for patience in (0, 30):
        pairing, sets = TimeSynchronizer(names, patience=patience), []
        left = {name: list(stream) for name in names}
        while any(left.values()):
            name = random.choice([name for name in names if left[name]])
            sets += pairing.add(name, left[name].pop(0), name)
        found.append(sets + pairing.flush())
    assert found[0] == found[1]
    assert len(found[0]) == len(stream)
