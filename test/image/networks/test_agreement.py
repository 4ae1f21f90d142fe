# SPDX-License-Identifier: Apache-2.0
"""Several networks' poses of one person: their mean, its confidence, and which of them has left and right exchanged."""

import numpy as np
import pytest

from flowing_puppet_ros.image.formats.skeletons import COCO_17
from flowing_puppet_ros.image.networks.agreement import calibrate, combine, turn_sides
from flowing_puppet_ros.image.networks.poses import NetworkPose

LEFT, RIGHT = COCO_17.index("left_elbow"), COCO_17.index("right_elbow")
ONES = np.ones(17)


def pose(shift: float = 0.0, score: float = 0.65) -> NetworkPose:
    """Return joints on a slanted line, 20 px from left to right of each pair."""
    rows = np.arange(17)
    x = np.where(rows == 0, 0.0, np.where(rows % 2, 10.0, -10.0)) + shift
    return NetworkPose(np.column_stack([x, 5.0 * rows]), np.full(17, score), score)


def test_mean_is_weighted_by_score_and_trust() -> None:
    mean, _ = combine([[pose(0.0, 0.6)], [pose(10.0, 0.2)]], [ONES, ONES], size=100.0)
    np.testing.assert_allclose(mean[0], (2.5, 0))  # (0.6 * 0 + 0.2 * 10) / 0.8
    trust = ONES.copy()
    trust[LEFT] = 0.5
    mean, _ = combine([[pose(0.0, 0.5)], [pose(9.0, 0.5)]], [ONES, trust], size=100.0)
    np.testing.assert_allclose(mean[[LEFT, RIGHT], 0], (10 + 3, -10 + 4.5))


@pytest.mark.parametrize(
    ("apart", "scores", "confidence"),
    [
        (0.0, (0.9, 0.9), 1.0),
        (20.0, (0.65, 0.65), 0.7),  # a fifth of the shoulder width
        (30.0, (0.65, 0.65), 0.525),  # half way between 0.7 and 0.35
        (20.0, (0.65, 0.0), 0.35),  # half the score that is sure, nearly
        (500.0, (0.9, 0.9), 0.05),
    ],
)
def test_confidence_is_how_well_the_poses_agree_in_shoulder_widths(
    apart: float, scores: tuple[float, float], confidence: float
) -> None:
    _, found = combine([[pose(0.0, scores[0])], [pose(apart, scores[1])]], [ONES, ONES], size=100.0)
    np.testing.assert_allclose(found, confidence, rtol=2e-3)


def test_two_poses_by_one_network_are_one_opinion() -> None:
    """Their mean is at 10 px: 20 px, or a fifth of the shoulder width, from the other network's."""
    mean, found = combine([[pose(0.0), pose(20.0)], [pose(30.0)]], [ONES, ONES], size=100.0)
    np.testing.assert_allclose(found, 0.7)
    np.testing.assert_allclose(mean[0, 0], 50 / 3)
    _, alone = combine([[pose(0.0), pose(200.0)]], [ONES], size=100.0)
    np.testing.assert_allclose(alone, 1.0)


def test_of_three_networks_the_two_that_agree_least_count() -> None:
    _, found = combine([[pose(0.0)], [pose(0.0)], [pose(20.0)]], [ONES] * 3, size=100.0)
    np.testing.assert_allclose(found, 0.7)


def test_a_single_pose_has_its_scores() -> None:
    mean, found = combine([[pose(3.0, 0.325)]], [ONES], size=100.0)
    np.testing.assert_allclose(mean, pose(3.0).joints)
    np.testing.assert_allclose(found, 0.5)
    assert combine([[pose(0.0, 0.9)]], [ONES], size=1.0)[1].max() == 1.0


def test_calibration_rises_from_nothing_to_nearly_one() -> None:
    told = calibrate(np.linspace(-0.2, 1.2, 200))
    assert (np.diff(told) >= 0).all() and told[0] == 0.0 and 0.9 < told[-1] <= 1.0
    assert calibrate(np.array([0.5]))[0] == pytest.approx(0.83)


def test_of_two_networks_of_which_one_has_the_sides_exchanged_the_last_decides() -> None:
    right = pose()
    for poses in ([right.exchange_sides(), right], [right.exchange_sides(), right.exchange_sides(), right]):
        for turned in turn_sides(poses, None):
            np.testing.assert_array_equal(turned.joints, right.joints)
    first, second = turn_sides([right, right.exchange_sides()], None)
    np.testing.assert_array_equal(first.joints, right.exchange_sides().joints)
    np.testing.assert_array_equal(second.joints, right.exchange_sides().joints)


def test_where_the_person_is_known_that_decides() -> None:
    right = pose()
    known = right.joints + 1.0
    known[:5] = np.nan
    for poses in ([right, right.exchange_sides()], [right.exchange_sides(), right]):
        for turned in turn_sides(poses, known):
            np.testing.assert_array_equal(turned.joints, right.joints)
    nothing = np.full((17, 2), np.nan)
    np.testing.assert_array_equal(
        turn_sides([right, right.exchange_sides()], nothing)[0].joints, right.exchange_sides().joints
    )


def test_poses_that_agree_stay_as_they_are_even_where_the_known_person_is_the_other_way() -> None:
    """A person may have turned round."""
    right = pose()
    for turned in turn_sides([right, pose(1.0)], right.exchange_sides().joints):
        assert turned.joints[LEFT, 0] > turned.joints[RIGHT, 0]
    assert turn_sides([right], right.exchange_sides().joints) == [right]
    assert turn_sides([], None) == []


def test_a_pose_without_numbers_turns_nobody() -> None:
    lost = NetworkPose(np.full((17, 2), np.nan), np.zeros(17), 0.0)
    first, _ = turn_sides([pose(), lost], None)
    np.testing.assert_array_equal(first.joints, pose().joints)
