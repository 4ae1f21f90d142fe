# SPDX-License-Identifier: Apache-2.0
"""Costs of a one-sided view, against a wall with known answers and against plain loops."""

import numpy as np
import pytest

from flowing_puppet_ros.evidence.cloud.one_sided import (
    MAX_DISTANCE_M,
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
