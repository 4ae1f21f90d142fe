# SPDX-License-Identifier: Apache-2.0
"""People who would be giants or dwarfs are told while a recording runs, in one sentence and once."""

import numpy as np
import pytest
from walkers import NAMES, photograph, ring, walker  # type: ignore[import-not-found]

from flowing_puppet_ros.multiview.association.people_tracker import PeopleTracker3D
from flowing_puppet_ros.multiview.bundle.gauge import scale_to
from flowing_puppet_ros.multiview.bundle.size_check import SizeCheck

CAMERAS = ring()


def replay(factor: float, sets: int = 14) -> list[str]:
    """Return what is told when the calibration is `factor` times too large."""
    random, wrong = np.random.default_rng(0), scale_to(CAMERAS, factor)
    tracker, check = PeopleTracker3D(NAMES), SizeCheck(NAMES)
    told = []
    for k in range(sets):
        seen = photograph(CAMERAS, {"ann": walker((0.2, 0.1), 0.3, 0.2 * k)}, 1.0, random)
        found = tracker.step(k * 33_000_000, wrong, seen)
        told.append(check.add(wrong, seen, [person.joints for person in found]))
    return [sentence for sentence in told if sentence]


@pytest.mark.parametrize(("factor", "metres"), [(1000.0, 1750.0), (100.0, 175.0), (7.0, 12.2), (0.001, 0.00175)])
def test_a_wrong_unit_is_one_sentence(factor: float, metres: float) -> None:
    (sentence,) = replay(factor)
    told = float(sentence.split("would be ")[1].split(" m tall")[0])
    assert told == pytest.approx(metres, rel=0.08)
    assert "--unit" in sentence
    unit = {1000.0: "in mm", 100.0: "in cm"}.get(factor)
    assert unit is None or unit in sentence


def test_metres_are_not_mentioned() -> None:
    assert replay(1.0) == []


def test_images_of_different_people_are_told_without_a_size() -> None:
    """Each camera shows somebody else, somewhere else."""
    random, check = np.random.default_rng(2), SizeCheck(NAMES)
    places = {"cam1": (0.0, 0.0), "cam2": (2.5, 0.0), "cam3": (-2.5, 1.0), "cam4": (0.5, -2.5)}
    told = []
    for k in range(12):
        seen = {}
        for name, place in places.items():
            seen |= photograph({name: CAMERAS[name]}, {"x": walker(place, 0.7 * k, k / 5)}, 1.0, random)
        told.append(check.add(CAMERAS, seen, []))
    (sentence,) = [each for each in told if each]
    assert "agree on nobody" in sentence and "tall" not in sentence
