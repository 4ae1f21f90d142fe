# SPDX-License-Identifier: Apache-2.0
"""Scans that show nothing useful give no body, or a sentence that says what is wrong, and huge ones are thinned."""

import numpy as np
import pytest

from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.scene.scene_cloud import SceneCloud
from flowing_puppet_ros.body.segmentation.floor_grid import looks_upside_down
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.body.track.scene_tracker import MAX_SCENE_POINTS, SceneSettings, SceneTracker
from flowing_puppet_ros.body.upright.found_body import SearchedScan
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.reporting import Report

RNG = np.random.default_rng(0)
TENTH = 100_000_000


def yard(count: int = 20_000) -> np.ndarray:
    """A floor 1.6 m below the sensor, a wall and a box."""
    floor = np.column_stack([RNG.uniform(-12, 12, (count, 2)), np.full(count, -1.6)])
    wall = np.column_stack([np.full(3000, 10.0), RNG.uniform(-8, 8, 3000), RNG.uniform(-1.6, 1.5, 3000)])
    box = RNG.uniform([4, -1, -1.6], [5.5, 1, -0.4], (2000, 3))
    return np.concatenate([floor, wall, box]) + RNG.normal(0, 0.01, (count + 5000, 3))


def find(points: np.ndarray) -> tuple[int, list[str]]:
    """Return how many bodies a scan gives, and the warnings."""
    report = Report()
    settings = SceneSettings(view="single")
    tracker = SceneTracker(BodyFitter(StitchedPuppet.load(), FitterSettings(threads=1)), settings, report)
    bodies, _ = tracker.step(SceneCloud(points, None, TENTH, single_view=True), 0)
    return len(bodies), report.drain_warnings()


@pytest.mark.parametrize("kind", ["rain", "ring", "line", "few"])
def test_rain_one_ring_a_line_and_a_few_points_give_no_body(kind: str) -> None:
    angle = np.linspace(0, 2 * np.pi, 1800)
    scans = {
        "rain": RNG.normal(0, 1, (20_000, 3)) * [6, 6, 2],
        "ring": np.column_stack([8 * np.cos(angle), 5 * np.sin(angle), np.full(1800, -0.3)]),
        "line": np.linspace(1, 20, 3000)[:, None] * [1.0, 0.0, 0.0],
        "few": yard()[:30],
    }
    assert find(scans[kind])[0] == 0


def test_a_sensor_that_hangs_head_first_is_told() -> None:
    assert find(yard() * [1, 1, -1])[1] == [
        "the floor seems to be above everything else: is the sensor upside down, or `up` set wrongly?"
    ]
    assert find(yard()) == (0, [])
    assert not looks_upside_down(yard()[20_000:])  # the floor was cut away


def test_a_flat_scan_and_a_tilted_sensor_are_told() -> None:
    angle = np.linspace(0, 2 * np.pi, 1800)
    assert "one ring" in find(np.column_stack([8 * np.cos(angle), 5 * np.sin(angle), np.full(1800, 0.0)]))[1][0]
    pitch = np.radians(20.0)
    turn = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]])
    assert "tilted by 20 degrees" in find(yard() @ turn)[1][0]


def test_a_scan_in_the_frame_of_a_map_is_refused_in_a_sentence() -> None:
    with pytest.raises(InputError, match=r"the nearest point .* beyond the segmentation\.max_range of 30 m"):
        find(yard() + np.array([500.0, 300.0, 20.0]))


@pytest.mark.slow
def test_millions_of_points_are_thinned(monkeypatch: pytest.MonkeyPatch) -> None:
    from flowing_puppet_ros.body.upright.person_finder import PersonFinder

    sizes = []

    def find_nobody(_: PersonFinder, scan: SearchedScan, *rest: object) -> list[object]:
        assert scan.scene is not None
        sizes.append(len(scan.scene.points))
        return []

    monkeypatch.setattr(PersonFinder, "find", find_nobody)
    find(yard(5_000_000))
    assert sizes == [MAX_SCENE_POINTS]
