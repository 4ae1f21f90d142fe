# SPDX-License-Identifier: Apache-2.0
"""HOTA, IDF1 and MOTA by hand, and against what trackeval says of the same tracks."""

import numpy as np
import pytest

from flowing_puppet_ros.evaluate.identity import FrameIdentities, IdentityCounts, count_identities

TRACKEVAL_FIRST = [29.456, 35.362, 24.685, 45.045, 0.0, 3]
TRACKEVAL_BOTH = [31.431, 38.697, 25.677, 45.333, 9.901, 8]


def draw(*numbers: float) -> float:
    """Return a fixed number in [0, 1) for some numbers, the same with every version of NumPy."""
    return float(np.sin(np.dot(numbers, (12.9898, 78.233, 37.719, 91.17)[: len(numbers)])) * 43758.5453 % 1.0)


def draw_clip(number: int) -> list[FrameIdentities]:
    """Return 20 frames of three people who come and go; in the second half two tracks are exchanged."""
    frames = []
    for k in range(20):
        true = tuple(who for who in range(3) if draw(number, k, who, 1) < 0.85)
        found = tuple(f"p{who}" for who in range(4) if draw(number, k, who, 2) < 0.8)
        similarity = np.empty((len(true), len(found)))
        for row, one in enumerate(true):
            expected = {0: 1, 1: 0}.get(one, one) if k >= 10 else one
            for column, other in enumerate(found):
                value = draw(number, k, 4 * one + int(other[1]), 3)
                similarity[row, column] = 0.4 + 0.6 * value if other == f"p{expected}" else 0.7 * value**3
        frames.append(FrameIdentities(true, found, similarity))
    return frames


def follow(ids: list[str], similarity: float = 1.0) -> list[FrameIdentities]:
    """Return frames with one true person; an empty id stands for nobody."""
    return [FrameIdentities(("a",), (who,) if who else (), np.full((1, 1 if who else 0), similarity)) for who in ids]


def test_figures_of_clips_are_those_of_trackeval() -> None:
    """The figures are of trackeval 1.3.0 on the same frames: HOTA, DetA, AssA, IDF1, MOTA, IDSW, of both combined."""
    both = [count_identities(draw_clip(number)) for number in (1, 2)]
    assert [*both[0].summarise().values()] == pytest.approx(TRACKEVAL_FIRST, abs=0.051)
    assert [*IdentityCounts.sum(both).summarise().values()] == pytest.approx(TRACKEVAL_BOTH, abs=0.051)


def test_a_perfect_track() -> None:
    perfect = {"hota": 100.0, "deta": 100.0, "assa": 100.0, "idf1": 100.0, "mota": 100.0, "id_switches": 0.0}
    assert count_identities(follow(["p"] * 5)).summarise() == perfect


def test_one_switch_in_the_middle() -> None:
    figures = count_identities(follow(["p"] * 5 + ["q"] * 5)).summarise()
    # Each match agrees with half of the true track.
    assert figures["deta"] == 100 and figures["assa"] == 50 and figures["hota"] == pytest.approx(70.7, abs=0.05)
    assert figures["idf1"] == 50 and figures["mota"] == 90 and figures["id_switches"] == 1


def test_misses_and_people_nobody_knows() -> None:
    figures = count_identities(follow(["p", "", "p", ""])).summarise()
    assert figures["deta"] == 50 and figures["assa"] == 50 and figures["mota"] == 50 and figures["id_switches"] == 0
    assert figures["idf1"] == pytest.approx(66.7, abs=0.05)
    ghost = [FrameIdentities(("a",), ("p", "g"), np.array([[1.0, 0.0]])) for _ in range(4)]
    assert count_identities(ghost).summarise() | {"hota": 0, "idf1": 0} == {
        "hota": 0, "deta": 50, "assa": 100, "idf1": 0, "mota": 0, "id_switches": 0
    }  # fmt: skip


def test_a_bad_place_counts_below_its_similarity_only() -> None:
    figures = count_identities(follow(["p"] * 4, 0.62)).summarise()
    assert figures["hota"] == figures["deta"] == figures["assa"] == pytest.approx(100 * 12 / 19, abs=0.05)
    assert figures["mota"] == 100
    worse = count_identities(follow(["p"] * 4, 0.42)).summarise()
    assert worse["mota"] == -100 and worse["idf1"] == 0


def test_an_id_is_kept_while_it_is_similar_enough() -> None:
    """MOTA stays with the last match although another is nearer; nothing is switched."""
    first = FrameIdentities(("a",), ("p",), np.array([[0.9]]))
    second = FrameIdentities(("a",), ("p", "q"), np.array([[0.6, 0.95]]))
    third = FrameIdentities(("a",), ("p", "q"), np.array([[0.3, 0.95]]))
    assert count_identities([first, second]).switches == 0
    assert count_identities([first, second, third]).switches == 1


def test_nobody() -> None:
    assert np.isnan([*IdentityCounts.sum([]).summarise().values()]).all()
    assert np.isnan(count_identities([FrameIdentities((), ("p",), np.zeros((0, 1)))]).summarise()["hota"])
    assert count_identities(follow(["", ""])).summarise()["mota"] == 0
