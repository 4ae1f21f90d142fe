# SPDX-License-Identifier: Apache-2.0
"""People found, missed, twice, badly posed and where nobody is, counted by hand; PCK against known distances."""

import numpy as np
import pytest

from flowing_puppet_ros.evaluate.joints import measure_pck
from flowing_puppet_ros.evaluate.people import PeopleTally, rate_people

NAMES = ("left_shoulder", "right_shoulder", "left_wrist", "left_hip", "right_hip")
Person = dict[str, np.ndarray]


def at(x: float, size: float = 100.0) -> Person:
    places = ((0.3, 0.0), (0.0, 0.0), (0.3, 0.5), (0.3, 1.0), (0.0, 1.0))
    return {name: np.array(place) * size + [x, 0.0] for name, place in zip(NAMES, places, strict=True)}


def count(found: list[Person], true: list[Person]) -> dict[str, float]:
    tally = PeopleTally()
    tally.add(found, true, NAMES)
    figures = tally.summarise("wrong")
    assert figures["people missed"] == figures["people"] - figures["people found"]
    kinds = ("people", "people found", "puppets twice on a person", "puppets badly on a person")
    return {"all": float(len(found))} | {kind: figures[kind] for kind in (*kinds, "puppets on nobody annotated")}


@pytest.mark.parametrize(
    ("found", "true", "expected"),
    [
        ([7.9], [0.0], (1, 1, 1, 0, 0, 0)),
        ([8.1], [0.0], (1, 1, 0, 0, 1, 0)),
        ([20.1], [0.0], (1, 1, 0, 0, 0, 1)),
        ([3.0, 0.0, 15.0], [0.0], (3, 1, 1, 2, 0, 0)),
        # Two in an embrace: a puppet counts for one of them only, and two puppets for both.
        ([3.0], [0.0, 6.0], (1, 2, 1, 0, 0, 0)),
        ([1.0, 3.0], [0.0, 6.0], (2, 2, 2, 0, 0, 0)),
        # The nearer pairing of the first would leave the second person without a puppet.
        ([-5.0, 1.0], [0.0, 8.0], (2, 2, 2, 0, 0, 0)),
        ([], [0.0], (0, 1, 0, 0, 0, 0)),
        ([300.0], [], (1, 0, 0, 0, 0, 1)),
    ],
)
def test_people_are_counted(found: list[float], true: list[float], expected: tuple[float, ...]) -> None:
    assert tuple(count([*map(at, found)], [*map(at, true)]).values()) == expected


def test_extent_is_the_person_s_own_and_missing_joints_are_far() -> None:
    assert count([at(7.0)], [at(0.0, 50.0)])["people found"] == 0, "7 px are more than 0.08 of 50"
    halved = {name: place for name, place in at(0.0).items() if name in NAMES[:2]}
    assert count([halved], [at(0.0)])["people found"] == 0, "three of five joints are missing"
    assert count([at(0.0)], [halved])["people found"] == 1, "joints that are not annotated are not asked for"


def test_precision_and_errors_of_those_found() -> None:
    tally = PeopleTally()
    bent = at(2.0) | {"left_wrist": np.array([60.0, 50.0])}
    tally.add([bent, at(0.5), at(900.0)], [at(0.0), at(400.0)], NAMES)
    assert tally.summarise("wrong")["precision of people, %"] == pytest.approx(100 / 3)
    assert tally.summarise("unknown")["precision of people, %"] == 50
    tally = PeopleTally()
    tally.add([bent], [at(0.0)], NAMES)
    figures = tally.summarise("wrong")
    assert figures["error of those found, median, % of extent"] == pytest.approx(2.0)
    assert figures["arm joints of those found within 8 % of extent, %"] == pytest.approx(200 / 3)
    assert np.isnan(PeopleTally().summarise("wrong")["precision of people, %"])


def test_unknown_people_leave_the_precision() -> None:
    found, score = [at(1.0), at(900.0), at(15.0)], np.array([0.5, 0.9, 0.4])
    wrong = rate_people(found, score, [at(0.0)], NAMES, "wrong")
    unknown = rate_people(found, score, [at(0.0)], NAMES, "unknown")
    assert wrong.similarity.shape == (3, 1) and wrong.score.tolist() == [0.5, 0.9, 0.4]
    assert unknown.score.tolist() == [0.5, 0.4], "a second puppet on an annotated person stays wrong"
    assert rate_people(found, score, [{"left_hip": np.zeros(2)}], NAMES, "wrong").similarity.shape == (3, 0)


def test_pck_by_torso_and_head() -> None:
    distance = np.array([[10.0, 21.0, np.nan], [np.inf, 9.0, 5.0]])
    figures = measure_pck(distance, np.array([100.0, 50.0]), np.array([np.nan, 10.0]))
    assert figures == pytest.approx({"PCK@0.2, %": 60.0, "PCKh@0.5, %": 100 / 3})
    assert measure_pck(distance, np.full(2, np.nan), np.full(2, np.nan)) == {}
