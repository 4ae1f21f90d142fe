# SPDX-License-Identifier: Apache-2.0
"""What the rays of a scan say: what hides a candidate, where nobody looked, and which rays end on a body."""

import numpy as np

from flowing_puppet_ros.body.segmentation.candidates import Candidate
from flowing_puppet_ros.body.upright.person_model import DecisionTrees
from flowing_puppet_ros.body.upright.rejected_places import RejectedPlaces
from flowing_puppet_ros.body.upright.scan_rays import ScanRays
from flowing_puppet_ros.evidence.cloud.one_sided import OneSidedView


def sheet(x: float, y: tuple[float, float], z: tuple[float, float], step: float = 0.02) -> np.ndarray:
    """A sheet at a right angle to x."""
    grid = np.meshgrid(np.arange(*y, step), np.arange(*z, step))
    return np.column_stack([np.full(grid[0].size, x), grid[0].ravel(), grid[1].ravel()])


def test_rays_end_on_before_and_behind_a_body() -> None:
    body = sheet(5.0, (-0.3, 0.3), (-1, 0.6))
    scan = np.concatenate([sheet(5.05, (-0.3, 0.0), (-1, 0.6)), sheet(8.0, (0.05, 1.0), (-1.6, 0.9))])
    rays = ScanRays(scan, np.zeros(3))
    count = rays.compare(np.arange(len(scan)), body, np.tile([-1.0, 0, 0], (len(body), 1)))
    on, behind, before, free, beside = (each.sum() for each in count)
    assert on > 0.95 * 15 * 80 and behind > 0.3 * on and before == 0
    assert free == beside > 50  # to the right, where the sheet behind goes on
    np.testing.assert_allclose(count.on / on, [0.45, 0.35, 0.2], atol=0.03)  # the bands' shares of the height
    nearer = ScanRays(sheet(3.0, (-0.3, 0.3), (-1, 0.6)), np.zeros(3))
    window = np.arange(len(nearer.points))
    count = nearer.compare(window, body, np.tile([-1.0, 0, 0], (len(body), 1)))
    assert count.on.sum() == count.behind.sum() == 0 and count.before.sum() > 100
    assert count.free.sum() == 0 and count.beside.sum() > 50


def test_what_stands_before_a_candidate_and_below_all_rays_is_unknown() -> None:
    person = sheet(5.0, (-0.25, 0.25), (-0.2, 0.5))
    car = sheet(3.0, (-1.0, 1.0), (-0.5, -0.15))
    rays = ScanRays(np.concatenate([person, car]), np.zeros(3))
    window = rays.find_window(person)
    unknown = rays.find_unknown(person, window)
    view = OneSidedView.build(person, np.zeros(3), unknown)
    legs, below, beside = np.array([[5.1, 0, -0.6]]), np.array([[5.1, 0, -1.2]]), np.array([[5.1, 0.45, 0.2]])
    for place in (legs, below):
        assert np.isinf(view.compare(place)[1][0]) and not view.compare(place)[0].any()
    assert view.compare(beside)[0].any()
    plain = OneSidedView.build(person, np.zeros(3))
    assert plain.compare(legs)[0].any()
    cost, _ = view.misfit(np.stack([legs, beside]), np.tile([-1.0, 0, 0], (2, 1, 1)))
    assert cost[0] == 0 and cost[1] > 0.05


def test_a_place_is_rejected_until_something_changes_or_time_has_passed() -> None:
    places = RejectedPlaces(10.0)
    machine = Candidate(np.arange(100), np.array([3.0, 1.0]), 0.0, 1.6, True)
    places.add(machine, 0)
    assert places.contains(machine, 5 * 10**9)
    assert places.contains(Candidate(np.arange(110), np.array([3.1, 1.1]), 0.0, 1.55, False), 10**9)
    for other in (
        Candidate(np.arange(100), np.array([3.5, 1.0]), 0.0, 1.6, True),
        Candidate(np.arange(100), np.array([3.0, 1.0]), 0.0, 1.9, True),
        Candidate(np.arange(200), np.array([3.0, 1.0]), 0.0, 1.6, True),
    ):
        assert not places.contains(other, 10**9)
    assert not places.contains(machine, 11 * 10**9)


def test_trees_follow_their_branches() -> None:
    # x0 <= 1: 0.2, else x1 <= 5: 0.4, else 1.0; and a tree that is one leaf of 0.6
    trees = DecisionTrees(
        np.array([0, 5]),
        np.array([0, -1, 1, -1, -1, -1]),
        np.array([1.0, 0, 5.0, 0, 0, 0]),
        np.array([1, 0, 3, 0, 0, 0]),
        np.array([2, 0, 4, 0, 0, 0]),
        np.array([0, 0.2, 0, 0.4, 1.0, 0.6]),
    )
    np.testing.assert_allclose(trees.predict(np.array([[0.0, 9], [2, 5], [2, 6]])), [0.4, 0.5, 0.8])
    assert len(trees.predict(np.empty((0, 2)))) == 0
    again = DecisionTrees.from_arrays(trees.to_arrays("filter"), "filter")
    np.testing.assert_array_equal(again.threshold, trees.threshold)
