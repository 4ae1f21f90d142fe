# SPDX-License-Identifier: Apache-2.0
"""Joints lifted into clouds of planes and boxes, where the depth is known."""

from dataclasses import replace

import numpy as np
import pytest

from flowing_puppet_ros.fusion.lift import find_lifted_onto_others, lift_joints
from flowing_puppet_ros.fusion.puppet_joints import PuppetJoints
from flowing_puppet_ros.fusion.seen_cloud import SeenCloud
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.multiview.camera import Camera

PLACES = {
    "neck": (320, 150), "belly": (320, 250), "right_shoulder": (280, 170), "left_shoulder": (360, 170),
    "right_hip": (300, 280), "left_hip": (340, 280), "right_elbow": (250, 220), "left_elbow": (390, 220),
    "left_wrist": (400, 270), "right_wrist": (240, 270),
}  # fmt: skip


def camera(aside: float = 0.0, lens: tuple[float, ...] = ()) -> Camera:
    return Camera.from_info([500, 0, 320, 0, 500, 240, 0, 0, 1], lens, 640, 480, np.eye(3), [-aside, 0, 0])


def wall(depth: float, low: float = -1.5, high: float = 1.5, step: float = 0.008) -> np.ndarray:
    """Return the points of a wall at a depth, between two x."""
    x, y = np.meshgrid(np.arange(low, high, step), np.arange(-1.2, 1.2, step))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, depth)], axis=1)


def puppet(model: StitchedPuppet, **moved: tuple[float, float]) -> PuppetJoints:
    pixels, confidence = np.full((len(model.joint_names), 2), np.nan), np.zeros(len(model.joint_names))
    for name, place in {**PLACES, **moved}.items():
        pixels[model.joint_names.index(name)] = place
        confidence[model.joint_names.index(name)] = 0.8
    return PuppetJoints("a1", pixels, confidence, np.zeros(len(confidence), dtype=bool))


@pytest.mark.parametrize(("aside", "lens"), [(0.0, ()), (0.05, ()), (0.0, (0.1, -0.2, 0.001, 0.0, 0.05))])
def test_joints_lie_behind_the_surface_on_their_rays(
    model: StitchedPuppet, aside: float, lens: tuple[float, ...]
) -> None:
    seen = SeenCloud.of(wall(2.5), camera(aside, lens))
    lifted = lift_joints(model, puppet(model), seen, np.ones(len(seen.points), dtype=bool))
    elbow, hip = model.joint_names.index("left_elbow"), model.joint_names.index("left_hip")
    for row, behind in ((elbow, 0.04), (hip, 0.10)):
        ray = lifted.rays[row]
        on_wall = np.array([aside, 0, 0]) + ray * 2.5 / ray[2]
        np.testing.assert_allclose(lifted.points[row], on_wall + behind * ray, atol=1e-6)
        np.testing.assert_allclose(
            camera(aside, lens).project(lifted.points[row])[0], puppet(model).pixels[row], atol=1e-6
        )
    assert lifted.depth == pytest.approx(2.5)


def test_who_stands_behind_a_counter_is_not_lifted_onto_it(model: StitchedPuppet) -> None:
    # A person of 1.7 m is 2.5 m away if shoulders and hips are 110 px apart; the counter hides the hips and what is
    # below, and one shoulder lies beside the person, on the wall.
    counter, person = wall(1.2), wall(2.5, -0.3, 0.19)
    counter, person = counter[counter[:, 1] > 0.02], person[person[:, 1] < 0.03]
    points = np.concatenate([counter, person, wall(4.0)])
    seen = SeenCloud.of(points, camera(0.006))  # a camera that stands apart does not see what others hide
    legs = {"right_knee": (300, 370), "left_knee": (340, 370), "right_ankle": (300, 450), "left_ankle": (340, 450)}
    found = puppet(model, **legs)
    lifted = lift_joints(model, found, seen, np.ones(len(points), dtype=bool))
    assert lifted.depth == pytest.approx(2.5)


def test_a_joint_in_a_hole_of_the_depth_has_no_depth_and_no_confidence(model: StitchedPuppet) -> None:
    points = wall(2.5)
    points = points[np.abs(points[:, :2] - (0.4, 0.15)).max(axis=1) > 0.06]  # around the wrist
    seen = SeenCloud.of(points, camera())
    lifted = lift_joints(model, puppet(model), seen, np.ones(len(points), dtype=bool))
    row = model.joint_names.index("left_wrist")
    assert not lifted.found[row]
    assert lifted.confidence[row] == 0
    assert np.isfinite(lifted.rays[row]).all()
    assert lifted.confidence[model.joint_names.index("right_wrist")] == 0.8


def test_a_lower_arm_without_any_depth_is_where_its_bones_are_likely(model: StitchedPuppet) -> None:
    points = np.concatenate([wall(2.5, -1.5, 0.3), wall(2.5, 0.5, 1.5)])  # elbow and wrist are at x = 0.35 and 0.4
    seen = SeenCloud.of(points, camera())
    lifted = lift_joints(model, puppet(model), seen, np.ones(len(points), dtype=bool))
    blank = [model.joint_names.index(name) for name in ("left_elbow", "left_wrist")]
    np.testing.assert_array_equal(np.flatnonzero(lifted.blank), sorted(blank))
    assert lifted.found[blank].all() and lifted.guessed[blank].all() and not lifted.hidden[blank].any()
    np.testing.assert_allclose(lifted.points[blank, 2], 2.5, atol=0.3)
    sparse = SeenCloud.of(points[::40], camera())  # a LiDAR's gaps are as wide
    assert not lift_joints(model, puppet(model), sparse, np.ones(len(sparse.points), dtype=bool)).blank.any()


@pytest.mark.parametrize("cut", [True, False])
def test_a_joint_beyond_the_border_or_on_what_is_not_the_person_is_where_bones_say(
    model: StitchedPuppet, cut: bool
) -> None:
    """The depth ends before the wrist, or its points are taken for the floor's: it is hidden, on its ray, in reach."""
    points = wall(2.5, -1.5, 0.3 if cut else 1.5)
    seen = SeenCloud.of(points, camera())
    lifted = lift_joints(model, puppet(model), seen, seen.points[:, 0] < 0.3)
    elbow, wrist = model.joint_names.index("left_elbow"), model.joint_names.index("left_wrist")
    assert lifted.found[wrist] and lifted.hidden[wrist]
    np.testing.assert_allclose(camera().project(lifted.points[wrist])[0], PLACES["left_wrist"], atol=1e-6)
    assert 0.15 < np.linalg.norm(lifted.points[wrist] - lifted.points[elbow]) < 0.35
    assert not lifted.hidden[model.joint_names.index("right_wrist")]


def test_hidden_hips_do_not_pull_the_trunk_to_the_table(model: StitchedPuppet) -> None:
    """Two shoulders and a neck on somebody at 3 m, two doubtful hips and a belly on a table at 2 m."""
    person, table = wall(3.0), wall(2.0)
    points = np.concatenate([person[person[:, 1] < -0.15], table[table[:, 1] > 0.0]])
    given = puppet(model)
    for name in ("left_hip", "right_hip", "belly"):
        given.confidence[model.joint_names.index(name)] = 0.3
    lifted = lift_joints(model, given, SeenCloud.of(points, camera()), np.ones(len(points), dtype=bool))
    assert lifted.depth == pytest.approx(3.0)
    assert lifted.found[model.joint_names.index("left_shoulder")]


def test_what_lies_far_behind_the_trunk_is_not_the_person(model: StitchedPuppet) -> None:
    cloud = np.concatenate([wall(2.5, -0.3, 0.3), wall(4.5, 0.3, 2.5)])
    lifted = lift_joints(
        model, puppet(model, left_wrist=(460, 270)), SeenCloud.of(cloud, camera()), np.full(len(cloud), True)
    )
    assert not lifted.found[model.joint_names.index("left_wrist")]


def test_a_joint_is_not_on_a_surface_that_no_bone_reaches(model: StitchedPuppet) -> None:
    behind = np.concatenate([wall(2.5, -1.5, 0.36), wall(3.0, 0.41, 1.5)])
    before = np.concatenate([wall(2.5, -1.5, 0.36), wall(2.4, 0.36, 1.5)])
    row = model.joint_names.index("left_wrist")
    for cloud, expected in ((behind, True), (before, False), (wall(2.5), False)):
        lifted = lift_joints(model, puppet(model), SeenCloud.of(cloud, camera()), np.full(len(cloud), True))
        assert lifted.hidden[row] == expected
        assert not lifted.hidden[model.joint_names.index("right_wrist")]


@pytest.mark.parametrize(("confidence", "hidden"), [(0.9, False), (0.3, True)])
def test_a_wrist_before_the_belly_is_behind_it_if_the_puppet_is_unsure(
    model: StitchedPuppet, confidence: float, hidden: bool
) -> None:
    person = puppet(model, left_elbow=(375, 220), left_wrist=(345, 240))
    row = model.joint_names.index("left_wrist")
    person.confidence[row] = confidence
    seen = SeenCloud.of(wall(2.5), camera())
    lifted = lift_joints(model, person, seen, np.ones(len(seen.points), dtype=bool))
    assert lifted.hidden[row] == hidden
    assert (lifted.points[row, 2] > 2.55) == hidden


def test_of_two_surfaces_at_a_pixel_the_bones_choose(model: StitchedPuppet) -> None:
    # At the wrist's pixel an edge: half of the points are those of a wall, in the reach of no arm.
    cloud = np.concatenate([wall(2.5, -1.5, 0.395), wall(3.1, 0.5, 2.5)])
    lifted = lift_joints(model, puppet(model), SeenCloud.of(cloud, camera()), np.full(len(cloud), True))
    row = model.joint_names.index("left_wrist")
    assert lifted.points[row, 2] == pytest.approx(2.5, abs=0.1)


def test_of_two_surfaces_at_a_pixel_the_clouds_before_choose(model: StitchedPuppet) -> None:
    # At the wrist's pixel an edge of two walls, both in reach; a body that jumped aside expects nothing.
    cloud = np.concatenate([wall(2.5, -1.5, 0.404), wall(2.7, 0.396, 1.5)])
    row = model.joint_names.index("left_wrist")

    def find(expected: np.ndarray | None) -> float:
        seen = SeenCloud.of(cloud, camera())
        lifted = lift_joints(model, puppet(model), seen, np.ones(len(cloud), dtype=bool), expected)
        return float(lifted.points[row, 2])

    known = lift_joints(model, puppet(model), SeenCloud.of(wall(2.5), camera()), np.full(len(wall(2.5)), True)).points
    for depth in (2.5, 2.7):
        expected = known.copy()
        expected[row] *= (depth + 0.025) / expected[row, 2]
        assert find(expected) == pytest.approx(depth + 0.025, abs=0.02)
        assert find(expected + np.array([0.4, 0.0, 0.0])) == find(None)


@pytest.mark.parametrize(("confidence", "known", "found"), [(0.8, True, True), (0.8, False, False), (0.4, True, False)])
def test_a_sure_joint_beside_a_thin_limb_of_somebody_known_is_on_it(
    model: StitchedPuppet, confidence: float, known: bool, found: bool
) -> None:
    cloud = np.concatenate([wall(2.5, -1.5, 0.3), wall(2.5, 0.33, 0.355), wall(4.5, 0.62, 2.5)])  # wrist: x = 0.4
    seen, usable = SeenCloud.of(cloud, camera()), np.full(len(cloud), True)
    expected = lift_joints(
        model, puppet(model), SeenCloud.of(wall(2.5), camera()), np.full(len(wall(2.5)), True)
    ).points
    given, row = puppet(model), model.joint_names.index("left_wrist")
    given.confidence[row] = confidence
    lifted = lift_joints(model, given, seen, usable, expected if known else None)
    assert lifted.found[row] == found
    if found:
        assert lifted.points[row, 2] == pytest.approx(2.525, abs=0.01)


def test_an_arm_that_is_on_a_neighbours_is_noticed(model: StitchedPuppet) -> None:
    """Of two people 0.5 m apart in depth, the farther one's left arm was found on the nearer one's right arm."""
    seen = SeenCloud.of(wall(2.5), camera())
    near = lift_joints(model, puppet(model), seen, np.ones(len(seen.points), dtype=bool))
    names = model.joint_names
    taken = [names.index(f"left_{name}") for name in ("elbow", "wrist")]
    points = near.points + np.array([-0.6, 0.0, 0.5])
    points[taken] = near.points[[names.index(f"right_{name}") for name in ("elbow", "wrist")]] + np.array(
        [0.02, 0.0, 0.0]
    )
    far = replace(near, points=points, depth=near.depth + 0.5)
    onto = find_lifted_onto_others([near, far], np.array([0.0, 0.0, 1.0]))
    assert not onto[0].any()
    assert np.flatnonzero(onto[1]).tolist() == sorted(taken)


def test_nothing_is_found_in_no_points(model: StitchedPuppet) -> None:
    lifted = lift_joints(model, puppet(model), SeenCloud.of(wall(2.5), camera()), np.zeros(len(wall(2.5)), dtype=bool))
    assert not lifted.found.any()
    assert np.isnan(lifted.depth)


def test_a_camera_beside_the_sensor_does_not_see_what_something_nearer_hides_from_it() -> None:
    board = wall(1.0, -0.2, 0.2)
    cloud = np.concatenate([board, wall(3.0)])
    seen = SeenCloud.of(cloud, camera(aside=0.3))
    # The camera 0.3 m to the right looks past the board's right edge at x = 0.2 to x = 0.0 on the wall.
    hidden = ~seen.seen[len(board) :]
    x, y = cloud[len(board) :, 0], cloud[len(board) :, 1]
    deep = (np.abs(y) < 0.8) & seen.in_view[len(board) :]
    assert hidden[deep & (x > -1.1) & (x < -0.1)].mean() > 0.97
    assert not hidden[deep & (x > 0.1) & (x < 1.2)].any()
    assert (seen.seen | ~seen.in_view)[: len(board)].all()
