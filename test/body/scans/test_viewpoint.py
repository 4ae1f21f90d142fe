# SPDX-License-Identifier: Apache-2.0
"""Clouds of one side of a surface: told from whole ones, and from where they were seen."""

import numpy as np
import pytest

from flowing_puppet_ros.body.scans.viewpoint import choose_viewpoint, estimate_viewpoint, find_viewpoint, is_seen_from

LIMBS = (
    (np.array([0.0, 0.0, 0.3]), np.array([0.16, 0.22, 0.45])),
    (np.array([0.0, 0.0, 0.85]), np.array([0.1, 0.1, 0.13])),
    (np.array([0.05, 0.1, -0.45]), np.array([0.09, 0.08, 0.45])),
    (np.array([-0.05, -0.1, -0.45]), np.array([0.09, 0.08, 0.45])),
)


def limbs(count: int, sensor: np.ndarray | None) -> np.ndarray:
    """Sample ellipsoids; with a sensor only what faces it, which is what it sees since no limb hides another much."""
    rng = np.random.default_rng(0)
    points = []
    for middle, radii in LIMBS:
        unit = rng.normal(size=(count, 3))
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        surface, normals = middle + radii * unit, unit / radii
        facing = np.ones(count, dtype=bool) if sensor is None else ((sensor - surface) * normals).sum(axis=1) > 0
        points.append(surface[facing])
    return np.concatenate(points)


PLACES = [np.array([3.0, -1.0, 0.2]), np.array([-2.0, 0.3, 0.9]), np.array([0.4, 4.0, -0.5])]


@pytest.mark.parametrize("sensor", PLACES, ids=str)
@pytest.mark.parametrize("count", [250, 3000])
@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_the_surface_tells_where_it_was_seen_from(sensor: np.ndarray, count: int, scale: float) -> None:
    front = limbs(count, sensor)
    front = scale * (front + 0.004 * np.random.default_rng(1).normal(size=front.shape))
    found = estimate_viewpoint(front + 50.0)
    assert found is not None
    middle = front.mean(axis=0)
    true, seen = scale * sensor - middle, found - 50.0 - middle
    assert true @ seen / np.linalg.norm(true) / np.linalg.norm(seen) > np.cos(np.radians(30))


@pytest.mark.parametrize("count", [200, 3000])
def test_whole_and_flat_clouds_have_no_viewpoint(count: int) -> None:
    whole = limbs(count, None)
    assert estimate_viewpoint(whole) is None and find_viewpoint(whole + np.array([3.0, 0, 0]), None) is None
    assert estimate_viewpoint(whole * [1, 1, 0]) is None


@pytest.mark.parametrize("count", [125, 1500])
def test_a_single_view_differs_from_a_whole_body_by_what_lies_behind(count: int) -> None:
    sensor = PLACES[0]
    front = limbs(count, sensor)
    assert is_seen_from(front, sensor)
    assert not is_seen_from(limbs(count, None), sensor)
    assert not is_seen_from(front, front.mean(axis=0))


def test_the_file_and_the_origin_are_believed_unless_the_surface_contradicts() -> None:
    sensor = PLACES[0]
    front = limbs(2000, sensor)
    np.testing.assert_array_equal(find_viewpoint(front - sensor, None), np.zeros(3))
    np.testing.assert_array_equal(find_viewpoint(front, sensor), sensor)
    # From behind, the front is one layer as well.
    behind = find_viewpoint(front + 2 * sensor, None)
    assert behind is not None and (behind - front.mean(axis=0) - 2 * sensor) @ sensor > 0


@pytest.mark.parametrize("angle", [60.0, 120.0, 180.0, 240.0])
def test_the_origin_of_a_map_is_not_taken_for_the_sensor(angle: float) -> None:
    sensor = PLACES[0]
    front = limbs(2000, sensor)
    turn = np.radians(angle)
    away = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]) @ sensor
    found = find_viewpoint(front - 3 * away, None)
    assert found is not None
    seen = found - (front - 3 * away).mean(axis=0)
    assert seen @ sensor / np.linalg.norm(seen) / np.linalg.norm(sensor) > np.cos(np.radians(30))


def test_a_view_known_to_be_single_takes_what_there_is() -> None:
    whole = limbs(500, None)
    np.testing.assert_array_equal(choose_viewpoint(whole + np.array([3.0, 0, 0]), None, None), np.zeros(3))
    assert choose_viewpoint(whole, None, None) is None
    normals = np.tile([0.0, 0.6, 0.8], (len(whole), 1))
    place = choose_viewpoint(whole, normals, None)
    assert place is not None
    away = place - whole.mean(axis=0)
    np.testing.assert_allclose(away / np.linalg.norm(away), [0, 0.6, 0.8])


def test_clouds_that_nobody_can_have_seen_from_a_side_have_no_viewpoint() -> None:
    """A tube that stands about the origin, which lies on the border of its box; and points all in one place."""
    angle, height = np.random.default_rng(0).uniform(0, 1, (2, 5000)) * [[2 * np.pi], [1.7]]
    tube = np.stack([0.2 * np.cos(angle), 0.2 * np.sin(angle), height + 1e-4], axis=1)
    assert find_viewpoint(tube, None) is None
    assert find_viewpoint(np.ones((500, 3)), None) is None
