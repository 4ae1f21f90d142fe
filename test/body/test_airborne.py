# SPDX-License-Identifier: Apache-2.0
"""Drops in the air are told from people, also from those who are far away."""

import numpy as np
import pytest

from flowing_puppet_ros.body.cloud.airborne import find_airborne
from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.scene.scene_cloud import SceneCloud
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.body.track.scene_tracker import SceneSettings, SceneTracker
from flowing_puppet_ros.body.upright.person_finder import PersonFinder
from flowing_puppet_ros.model.sp import StitchedPuppet

HEIGHT = 1.5


def scan(lowest: float, highest: float, rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Return what rings see of a floor, a wall at x = 25 and two columns as wide as people (N, 3) m, and on which."""
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(-60, 60, 0.2)), np.radians(np.linspace(lowest, highest, rings))
    )
    ray = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    )
    ray = ray.reshape(-1, 3)
    away = np.minimum(25.0 / ray[:, 0], np.where(ray[:, 2] < 0, -HEIGHT / np.minimum(ray[:, 2], -1e-9), np.inf))
    owner = np.full(len(ray), -1)
    for number, (x, y) in enumerate(((4.0, 1.2), (14.0, -4.0))):
        t = x / ray[:, 0]
        hit = (np.abs(t * ray[:, 1] - y) < 0.22) & (t * ray[:, 2] < 1.7 - HEIGHT) & (t < away)
        away[hit], owner[hit] = t[hit], number
    return ray * away[:, None], owner


def let_it_rain(points: np.ndarray, share: float) -> np.ndarray:
    """Return drops (D, 3) m that stop a share of the rays 2 to 6 m away, off the floor and the nearer column."""
    rng = np.random.default_rng(1)
    rain = points[rng.integers(0, len(points), int(share * len(points)))]
    rain = rain * (rng.uniform(2.0, 6.0, len(rain)) / np.linalg.norm(rain, axis=1))[:, None]
    clear = (rain[:, 2] > 0.5 - HEIGHT) & (np.hypot(*(rain[:, :2] - [4.0, 1.2]).T) > 0.7)
    return np.asarray(rain[clear])


@pytest.mark.parametrize("rings", [(-15, 15, 16), (-24, 8, 64), (-22.5, 22.5, 128)])
def test_drops_hang_in_the_air_and_people_do_not(rings: tuple[float, float, int]) -> None:
    points, owner = scan(*rings)
    alone = find_airborne(np.concatenate([points, let_it_rain(points, 0.02)]), np.zeros(3))
    assert alone[len(points) :].mean() > 0.8
    for person in (0, 1):
        assert (owner == person).sum() > 20 and not alone[: len(points)][owner == person].any()
    assert alone[: len(points)].mean() < 0.002


def test_the_few_points_that_hang_alone_in_clear_air_are_kept() -> None:
    points, _ = scan(-24, 8, 64)
    rain = let_it_rain(points, 0.02)[:50]
    assert not find_airborne(np.concatenate([points, rain]), np.zeros(3)).any()


def test_it_does_not_matter_where_the_sensor_is() -> None:
    points = scan(-15, 15, 16)[0]
    points, place = np.concatenate([points, let_it_rain(points, 0.03)]), np.array([200.0, -50.0, 3.0])
    here, moved = find_airborne(points, np.zeros(3)), find_airborne(points + place, place)
    assert here.sum() > 100 and (here != moved).sum() <= 4


def test_what_is_beyond_all_people_is_kept() -> None:
    far = np.random.default_rng(3).uniform(40.0, 900.0, (300, 3))
    assert not find_airborne(far, np.zeros(3)).any()


def test_drops_are_no_part_of_the_scene_in_which_people_are_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    points, _ = scan(-24, 8, 64)
    rain = let_it_rain(points, 0.02)
    searched = []

    def find(finder: PersonFinder, scene: object, *_: object) -> list[object]:
        searched.append(scene)
        return []

    monkeypatch.setattr(PersonFinder, "find", find)
    tracker = SceneTracker(BodyFitter(StitchedPuppet.load(), FitterSettings(threads=1)), SceneSettings(view="single"))
    tracker.step(SceneCloud(np.concatenate([points, rain]), None, 1), 0)
    assert len(searched[0].scene.points) < len(points) + 0.2 * len(rain)  # type: ignore[attr-defined]
