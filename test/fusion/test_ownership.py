# SPDX-License-Identifier: Apache-2.0
"""Points shared out among capsules by hand-made distances."""

import numpy as np

from flowing_puppet_ros.body.cloud.limb_crop import list_capsules
from flowing_puppet_ros.fusion.ownership import assign_points


def bone(x: float, first: float = 0.1, second: float = 0.1) -> np.ndarray:
    """Return a vertical capsule of a metre at x."""
    return np.array([[x, 0, 0, x, 0, 1, first, second]])


def test_points_go_to_the_nearest_limb_in_radii() -> None:
    points = np.array([[0.1, 0, 0.5], [0.26, 0, 0.5], [0.34, 0, 0.5], [0.5, 0, 0.5]])
    # Midway between equal limbs at 0.3; a limb of twice the radius reaches two thirds of the way.
    assert assign_points(points, [bone(0.0), bone(0.6)]).tolist() == [0, -1, -1, 1]
    assert assign_points(points, [bone(0.0, 0.2, 0.2), bone(0.6)]).tolist() == [0, 0, 0, 1]


def test_radii_taper_and_ends_are_round() -> None:
    limb = [bone(0.0, 0.1, 0.05)]
    points = np.array([[0.19, 0, 0.0], [0.19, 0, 1.0], [0.09, 0, 1.0], [0, 0, 1.09], [0, 0, 1.14]])
    assert assign_points(points, limb).tolist() == [0, -1, 0, 0, -1]


def test_the_surface_goes_on_beyond_two_radii_but_not_across_a_gap() -> None:
    joined = np.column_stack([np.arange(0.1, 0.32, 0.01), np.zeros(22), np.full(22, 0.5)])
    assert (assign_points(joined, [bone(0.0)])[joined[:, 0] < 0.3] == 0).all()
    apart = joined[(joined[:, 0] < 0.2) | (joined[:, 0] > 0.245)]
    found = assign_points(apart, [bone(0.0)])
    assert (found[apart[:, 0] < 0.195] == 0).all()
    assert (found[apart[:, 0] > 0.245] == -1).all()


def test_growth_stops_at_a_neighbour() -> None:
    joined = np.column_stack([np.arange(0.1, 0.51, 0.01), np.zeros(41), np.full(41, 0.5)])
    found = assign_points(joined, [bone(0.0), bone(0.6)])
    assert (found[joined[:, 0] < 0.29] == 0).all()
    assert (found[joined[:, 0] > 0.31] == 1).all()


def test_nobody_owns_anything_without_people_or_points() -> None:
    assert assign_points(np.zeros((3, 3)), []).tolist() == [-1, -1, -1]
    assert assign_points(np.zeros((3, 3)), [np.empty((0, 8))]).tolist() == [-1, -1, -1]
    assert assign_points(np.empty((0, 3)), [bone(0.0)]).tolist() == []


def test_capsules_of_unknown_joints_are_left_out() -> None:
    capsules = list_capsules({"left_knee": np.zeros(3), "left_ankle": np.array([0, 0, -0.4])})
    np.testing.assert_allclose(capsules, [[0, 0, 0, 0, 0, -0.4, 0.065, 0.045]])


def test_capsules_whose_far_end_is_not_sure_are_left_out() -> None:
    joints = {"left_elbow": np.zeros(3), "left_wrist": np.array([0, 0, -0.3]), "left_hand": np.array([0, 0, -0.4])}
    capsules = list_capsules(joints, {"left_wrist"})
    np.testing.assert_allclose(capsules, [[0, 0, 0, 0, 0, -0.3, 0.045, 0.035]])
