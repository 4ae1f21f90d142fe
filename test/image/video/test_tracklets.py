# SPDX-License-Identifier: Apache-2.0
"""Places of people joined over a clip."""

import numpy as np
import pytest

from flowing_puppet_ros.image.detector.detection import PersonCandidate
from flowing_puppet_ros.image.video.tracklets import TrackletLinker


def place(x: float, y: float = 50.0, scale: float = 40.0, log_odds: float = 1.0) -> PersonCandidate:
    return PersonCandidate(np.array([x, y]), np.array([x, y - 0.5 * scale]), scale, log_odds)


def people(
    runs: list[list[PersonCandidate]], stride: int = 1, min_probability: float = 0.3, max_people: int = 8
) -> TrackletLinker:
    clip = TrackletLinker(min_probability, max_people, stride)
    for number, places in enumerate(runs):
        clip.add(number * stride, places)
    return clip


def test_the_place_that_is_always_there_beats_surer_ones_that_jump() -> None:
    rng = np.random.default_rng(0)
    elsewhere = rng.uniform(150, 900, (20, 2))
    runs = [[place(100 + k, log_odds=0.0), place(x, y, log_odds=1.5)] for k, (x, y) in enumerate(elsewhere)]
    first = people(runs).link()[0]
    assert [first.places[k].neck[0] for k in range(20)] == pytest.approx([100 + k for k in range(20)])


def test_the_size_is_what_most_looks_say() -> None:
    runs = [[place(100, scale=25.0 if k % 4 == 0 else 40.0)] for k in range(21)]
    path = people(runs).link()[0]
    assert {round(one.scale, 6) for one in path.places.values()} == {40.0}
    face = path.places[0].face - path.places[0].neck
    assert face == pytest.approx([0.0, -20.0])


def test_a_missed_look_is_filled_in_and_places_between_looks_are_means() -> None:
    runs = [[place(100.0 + 10 * k)] if k != 3 else [] for k in range(7)]
    path = people(runs, stride=2).link()[0]
    found = path.at(6)
    assert found is not None and found.neck == pytest.approx([130.0, 50.0])
    odd = path.at(3)
    assert odd is not None and odd.neck == pytest.approx([115.0, 50.0])


def test_before_and_after_the_path_the_person_must_show_to_be_believed() -> None:
    runs: list[list[PersonCandidate]] = [
        *[[] for _ in range(20)],
        *[[place(100)] for _ in range(4)],
        *[[] for _ in range(20)],
    ]
    path = people(runs, stride=3).link()[0]
    for image in (58, 60, 69, 71):
        found = path.at(image)
        assert found is not None and found.min_score == -np.inf
    for image in (57, 72, 15, 114):
        supposed = path.at(image)
        assert supposed is not None and supposed.neck[0] == 100.0 and supposed.min_score < supposed.score
    assert path.at(14) is None and path.at(115) is None


def test_two_people_are_two_paths_and_the_surer_comes_first() -> None:
    runs = [[place(100, log_odds=0.5), place(103, log_odds=0.2), place(300, log_odds=2.0)] for _ in range(5)]
    paths = people(runs).link()
    assert [path.places[0].neck[0] for path in paths] == [300.0, 100.0]
    assert len(people(runs, max_people=1).link()) == 1


def test_an_unsure_second_person_is_none_but_an_unsure_first_one_is_told() -> None:
    runs = [[place(100, log_odds=-2.0), place(300, log_odds=-2.5)] for _ in range(5)]
    paths = people(runs).link()
    assert [path.places[0].neck[0] for path in paths] == [100.0]
    assert -2.0 < paths[0].places[0].log_odds < 0.0


def test_a_path_does_not_jump() -> None:
    runs = [[place(100)]] * 5 + [[place(400)]] * 5
    paths = people(runs).link()
    assert len(paths) == 2 and {max(path.places) for path in paths} == {4, 9}


@pytest.mark.parametrize(
    "runs", [[], [[]], [[], []], [[place(1, log_odds=-9.0)]], [[place(1, log_odds=-3.5 + 1e-3)]] * 2]
)
def test_nobody(runs: list[list[PersonCandidate]]) -> None:
    assert people(runs).link() == []
