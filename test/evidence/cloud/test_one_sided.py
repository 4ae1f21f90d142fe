# SPDX-License-Identifier: Apache-2.0
"""Costs of a one-sided view, against a wall with known answers and against plain loops."""

import numpy as np
import pytest

from flowing_puppet_ros.evidence.cloud.one_sided import (
    MAX_DISTANCE_M,
    MAX_STRETCH,
    OCCLUSION_DEPTH_M,
    OneSidedView,
    distances,
    mean_distance,
)

SENSOR = np.array([1.0, -2.0, 0.5])
SPACING = 0.01


@pytest.fixture(scope="module")
def wall() -> OneSidedView:
    """A wall of 1 m by 1 m, two metres in front of the sensor along x, with a point every centimetre."""
    y, z = np.meshgrid(np.arange(-0.5, 0.505, SPACING), np.arange(-0.5, 0.505, SPACING))
    return OneSidedView.build(np.stack([np.full(y.size, 2.0), y.ravel(), z.ravel()], axis=1) + SENSOR, SENSOR)


def test_points_are_in_front_of_behind_or_beside_the_wall(wall: OneSidedView) -> None:
    beside, behind = wall.compare(
        SENSOR + np.array([[1.5, 0.1, 0.1], [2.3, 0.1, 0.1], [2.0, 0.8, 0.0], [4.0, 1.6, 0.0]])
    )
    np.testing.assert_allclose(behind[:2], [-0.5, 0.3], atol=1e-9)
    assert not beside[:2].any()
    # 0.3 m beside the edge, less what may still be between two points of the wall; twice that twice as far away.
    np.testing.assert_allclose(beside[2], [0, 0.3, 0], atol=2.5 * SPACING)
    np.testing.assert_allclose(beside[3], 2 * beside[2], atol=1e-9)
    hidden = wall.find_hidden(
        SENSOR
        + np.array([[2 + 2 * OCCLUSION_DEPTH_M, 0, 0], [2 + OCCLUSION_DEPTH_M / 2, 0, 0], [1.9, 0, 0], [3.0, 2.0, 0]])
    )
    assert hidden.tolist() == [True, False, False, False]


def test_only_what_contradicts_the_view_costs(wall: OneSidedView) -> None:
    toward, away = np.array([-1.0, 0, 0]), np.array([1.0, 0, 0])
    cases = (
        ([2.0, 0, 0], toward, 0.0),
        ([2.03, 0, 0], toward, 0.03),
        ([2.5, 0, 0], toward, OCCLUSION_DEPTH_M),
        ([2.5, 0, 0], away, 0.0),
        ([1.9, 0, 0], away, 0.1),
        ([1.0, 0, 0], toward, MAX_DISTANCE_M),
        ([2.0, 3.0, 0], toward, MAX_DISTANCE_M),
    )
    points = np.array([[SENSOR + place] for place, _, _ in cases])
    cost, facing = wall.misfit(points, np.array([[normal] for _, normal, _ in cases]))
    np.testing.assert_allclose(cost, [expected for _, _, expected in cases], atol=1e-9)
    assert facing[:, 0].tolist() == [normal is toward for _, normal, _ in cases]
    together, _ = wall.misfit(points[:, 0][None], np.array([normal for _, normal, _ in cases])[None])
    np.testing.assert_allclose(together, cost.mean())


def test_the_view_does_not_depend_on_the_frame(wall: OneSidedView) -> None:
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    body = rng.normal(size=(2000, 3)) * [0.1, 0.3, 0.5] + [3, 0, 0]
    probes = rng.normal(size=(300, 3)) * 0.5 + [3, 0, 0]
    here = OneSidedView.build(body, np.zeros(3)).compare(probes)
    there = OneSidedView.build(body @ turn.T + SENSOR, SENSOR).compare(probes @ turn.T + SENSOR)
    inside = ~here[0].any(axis=1) & ~there[0].any(axis=1)
    assert (here[0].any(axis=1) == there[0].any(axis=1)).mean() > 0.97
    assert np.median(np.abs(here[1] - there[1])[inside]) < 0.05


def test_nearest_distances_are_those_of_plain_loops() -> None:
    rng = np.random.default_rng(1)
    points, targets = rng.uniform(0, 0.4, (3, 20, 3)), rng.uniform(0, 0.4, (15, 3))
    allowed = rng.random((3, 20)) < 0.5
    allowed[2] = False
    gaps = np.linalg.norm(points[:, None] - targets[None, :, None], axis=3)
    expected = np.minimum(np.where(allowed[:, None], gaps, np.inf).min(axis=2), MAX_DISTANCE_M)
    np.testing.assert_allclose(distances(targets, points, allowed), expected)
    np.testing.assert_allclose(
        mean_distance(points, targets), np.minimum(gaps.min(axis=1), MAX_DISTANCE_M).mean(axis=1)
    )


def scan_with_rings(gap_deg: float, step_deg: float) -> np.ndarray:
    """Scan the wall of 1 m by 1 m, two metres ahead along x, with rings of a LiDAR; (N, 3) m from the sensor."""
    elevation, azimuth = np.radians(np.arange(-14.0, 14.1, gap_deg)), np.radians(np.arange(-14.0, 14.1, step_deg))
    e, a = (grid.ravel() for grid in np.meshgrid(elevation, azimuth, indexing="ij"))
    points = np.stack([np.full(e.size, 2.0), 2 * np.tan(a), 2 * np.tan(e) / np.cos(a)], axis=1)
    return points[(np.abs(points[:, 1:]) <= 0.5).all(axis=1)]


@pytest.mark.parametrize(("gap", "step"), [(2.0, 0.2), (1.3, 0.2), (0.2, 1.6)])
def test_what_lies_between_rings_is_not_beside_the_silhouette(gap: float, step: float) -> None:
    points = scan_with_rings(gap, step)
    view = OneSidedView.build(points + SENSOR, SENSOR)
    assert view.stretch == pytest.approx(np.clip(gap / step, 1 / MAX_STRETCH, MAX_STRETCH), rel=0.25)
    between = scan_with_rings(0.31, 0.47)
    between = between[np.abs(between[:, 1:]).max(axis=1) < np.abs(points[:, 1:]).max(axis=0).min()]
    beside, behind = view.compare(between + SENSOR)
    assert len(between) > 1000 and not beside.any()
    np.testing.assert_allclose(behind, 0.0, atol=1e-3)
    # Farther outside than from ring to ring: as far beside the silhouette as it is, and in that direction.
    beside, _ = view.compare(np.array([[2.0, 0.8, 0.0], [2.0, 0.0, -0.9]]) + SENSOR)
    slack = 2.0 * np.tan(np.radians(1.2 * max(gap, step)))
    np.testing.assert_allclose(beside, [[0, 0.3, 0], [0, 0, -0.4]], atol=slack + 0.07)
    assert (np.abs(beside).max(axis=1) > 0.1).all()


def test_gaps_of_a_depth_image_are_the_same_down_and_across(wall: OneSidedView) -> None:
    assert wall.stretch == 1.0
