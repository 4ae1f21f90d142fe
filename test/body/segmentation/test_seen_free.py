# SPDX-License-Identifier: Apache-2.0
"""What comes to where the sensor saw through is told from what was there, and nothing is when the sensor moves."""

import numpy as np

from flowing_puppet_ros.body.segmentation.seen_free import MOVING_SCANS, SeenFree


def scan_wall(person_y: float | None, sensor: np.ndarray, noise: int) -> tuple[np.ndarray, np.ndarray]:
    """Scan a wall at x = 8 m and somebody, half a metre wide, at x = 5 m; points (N, 3) m and who is a person (N,)."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(-40, 40, 0.4)), np.radians(np.arange(-9, 9, 1.5)))
    ray = np.stack([np.ones(azimuth.size), np.tan(azimuth.ravel()), np.tan(elevation.ravel())], axis=1)
    at_person = sensor + ray * (5 - sensor[0])
    person = np.zeros(len(ray), bool) if person_y is None else np.abs(at_person[:, 1] - person_y) < 0.25
    points = np.where(person[:, None], at_person, sensor + ray * (8 - sensor[0]))
    return points + np.random.default_rng(noise).normal(0, 0.02, points.shape), person


def test_who_walks_in_has_come_and_wall_and_who_stands_have_not() -> None:
    free, still = SeenFree(), np.zeros(3)
    for step in range(8):
        points, person = scan_wall(-2.0 + 0.15 * step, still, step)
        assert not free.add(points, still)[~person].any()
    points, person = scan_wall(-0.8, still, 9)
    assert free.add(points, still)[person].mean() > 0.5
    free.reset()
    for step in range(8):
        points, person = scan_wall(1.0, still, step)
        assert not free.add(points, still).any()


def test_a_moved_sensor_in_its_own_frame_shows_nothing_and_in_a_fixed_one_the_same() -> None:
    own = SeenFree()
    points, _ = scan_wall(None, np.zeros(3), 0)
    for _ in range(8):
        own.add(points, np.zeros(3))
    moves = [own.moves]
    for _ in range(MOVING_SCANS + 1):  # in the first of them all seems to have come
        assert not own.add(points - [1.5, 0.0, 0.0], np.zeros(3)).any()
        moves.append(own.moves)
    assert moves == [False, *[True] * MOVING_SCANS, False]
    fixed = SeenFree()
    for step in range(12):
        place = np.array([0.1 * step, 0.0, 0.0])
        points, _ = scan_wall(None, place, step)
        assert not fixed.add(points, place).any()
    points, person = scan_wall(0.3, place, 20)
    assert fixed.add(points, place)[person].mean() > 0.5
