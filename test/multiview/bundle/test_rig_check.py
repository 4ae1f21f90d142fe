# SPDX-License-Identifier: Apache-2.0
"""Giants, dwarfs and cameras that are off are told while a recording runs, in one sentence and once."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from walkers import NAMES, photograph, ring, walker  # type: ignore[import-not-found]

from flowing_puppet_ros.multiview.association.people_tracker import PeopleTracker3D
from flowing_puppet_ros.multiview.association.view import PersonInView
from flowing_puppet_ros.multiview.bundle.gauge import scale_to
from flowing_puppet_ros.multiview.bundle.rig_check import RigCheck
from flowing_puppet_ros.multiview.camera import Camera

CAMERAS = ring()


def run_through(wrong: dict[str, Camera], sets: int = 14) -> list[str]:
    """Return what is told with a calibration that may be wrong."""
    random = np.random.default_rng(0)
    tracker, check = PeopleTracker3D(NAMES), RigCheck(NAMES)
    told = []
    for k in range(sets):
        seen = photograph(CAMERAS, {"ann": walker((0.2, 0.1), 0.3, 0.2 * k)}, 1.0, random)
        found = tracker.step(k * 33_000_000, wrong, seen)
        told.append(check.add(wrong, seen, found))
    return [sentence for sentence in told if sentence]


@pytest.mark.parametrize(("factor", "metres"), [(1000.0, 1750.0), (100.0, 175.0), (7.0, 12.2), (0.001, 0.00175)])
def test_a_wrong_unit_is_one_sentence(factor: float, metres: float) -> None:
    (sentence,) = run_through(scale_to(CAMERAS, factor))
    told = float(sentence.split("would be ")[1].split(" m tall")[0])
    assert told == pytest.approx(metres, rel=0.08)
    assert "--unit" in sentence
    unit = {1000.0: "in mm", 100.0: "in cm"}.get(factor)
    assert unit is None or unit in sentence


def test_metres_are_not_mentioned() -> None:
    assert run_through(CAMERAS) == []


def turn_camera(degrees: float) -> dict[str, Camera]:
    turn = Rotation.from_rotvec([0.0, np.radians(degrees), 0.0]).as_matrix()
    camera = CAMERAS["cam3"]
    return CAMERAS | {"cam3": replace(camera, rotation=turn @ camera.rotation, translation=turn @ camera.translation)}


def test_a_camera_that_was_turned_is_named() -> None:
    (sentence,) = run_through(turn_camera(0.9))  # 8 cm at 5 m
    assert sentence.startswith("half of the joints in cam3 lie") and "cam1" not in sentence
    assert 6 < float(sentence.split("more than ")[1].split(" cm")[0]) < 10
    (sentence,) = run_through(turn_camera(3.0))
    assert sentence.startswith("cam3 shows nobody whom the others show") and "flowing-puppet calibrate" in sentence


def test_images_of_different_people_are_told_without_a_size() -> None:
    """Each camera shows somebody else, somewhere else."""
    random, check = np.random.default_rng(2), RigCheck(NAMES)
    places = {"cam1": (0.0, 0.0), "cam2": (2.5, 0.0), "cam3": (-2.5, 1.0), "cam4": (0.5, -2.5)}
    told = []
    for k in range(12):
        seen: dict[str, list[PersonInView]] = {}
        for name, place in places.items():
            seen |= photograph({name: CAMERAS[name]}, {"x": walker(place, 0.7 * k, k / 5)}, 1.0, random)
        told.append(check.add(CAMERAS, seen, []))
    (sentence,) = [each for each in told if each]
    assert "agree on nobody" in sentence and "tall" not in sentence
