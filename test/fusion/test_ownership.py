# SPDX-License-Identifier: Apache-2.0
"""Points shared out among capsules by hand-made distances."""

import numpy as np

from flowing_puppet_ros.body.cloud.limb_crop import list_capsules
from flowing_puppet_ros.fusion.ownership import OUTSIDE, SHOWN, UNSEEN, assign_points, find_shown
from flowing_puppet_ros.fusion.puppet_joints import PuppetJoints
from flowing_puppet_ros.fusion.seen_cloud import SeenCloud
from flowing_puppet_ros.image.person_mask import PersonMask
from flowing_puppet_ros.multiview.camera import Camera

EYE = Camera.from_info([500, 0, 320, 0, 500, 240, 0, 0, 1], [], 640, 480, np.eye(3), np.zeros(3))
BONES = [(2, 3)]


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


def says(shown: np.ndarray) -> np.ndarray:
    """Return what a mask says that shows some points and not the others."""
    return np.where(shown, np.int8(SHOWN), np.int8(OUTSIDE))


def test_a_mask_says_whose_points_are_whose_beyond_the_limbs_too() -> None:
    joined = np.column_stack([np.arange(0.1, 0.42, 0.01), np.zeros(32), np.full(32, 0.5)])
    x = joined[:, 0]
    assert (assign_points(joined, [bone(0.0)], [says(x < 0.15)])[x > 0.155] == -1).all()
    assert (assign_points(joined, [bone(0.0)], [says(x < 0.37)])[x < 0.365] == 0).all()
    # What the camera does not tell is the person's by its distance.
    unseen = np.full(len(x), UNSEEN, dtype=np.int8)
    np.testing.assert_array_equal(assign_points(joined, [bone(0.0)], [unseen]), assign_points(joined, [bone(0.0)]))
    # Within a mask it goes on across a gap of 4.5 cm.
    apart = joined[(x < 0.2) | (x > 0.245)]
    assert (assign_points(apart, [bone(0.0)], [says(apart[:, 0] < 0.5)])[apart[:, 0] < 0.4] == 0).all()
    # Of two people the second has no mask, and what is not the first one's may be theirs.
    found = assign_points(joined, [bone(0.0), bone(0.5)], [says(x < 0.2), None])
    assert (found[x < 0.195] == 0).all()
    assert (found[x > 0.305] == 1).all()


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


def standing(mask: PersonMask | None, ankle: tuple[float, float] = (320.0, 360.0)) -> PuppetJoints:
    """Return somebody with shoulders, a knee and an ankle, all sure, and one joint that is not."""
    pixels = np.array([[290.0, 110.0], [350.0, 110.0], [320.0, 280.0], ankle, [600.0, 100.0]])
    return PuppetJoints("a1", pixels, np.array([0.9, 0.9, 0.9, 0.9, 0.2]), np.zeros(5, dtype=bool), mask)


def mask_of(left: int, top: int, right: int, bottom: int) -> PersonMask:
    values = np.zeros((480, 640), dtype=np.uint8)
    values[top:bottom, left:right] = 255
    return PersonMask.of_grid(values, (640, 480))


def see(*pixels: tuple[float, float]) -> SeenCloud:
    """Return points at 2.5 m that have these pixels."""
    return SeenCloud.of(2.5 * np.column_stack([(np.array(pixels) - (320, 240)) / 500, np.ones(len(pixels))]), EYE)


def test_points_beside_a_mask_are_not_the_persons() -> None:
    seen = see((320, 200), (403, 200), (395, 355))
    aside = SeenCloud.of(np.array([[9.0, 0.0, 2.5]]), EYE)  # outside of the image
    assert find_shown(aside, standing(mask_of(270, 60, 400, 370)), BONES) == np.array([UNSEEN])
    found = find_shown(seen, standing(mask_of(270, 60, 400, 370)), BONES)
    assert found is not None
    assert found.tolist() == [SHOWN, OUTSIDE, SHOWN]
    moved = mask_of(270, 60, 400, 370).move(np.zeros(2), 5.0)
    found = find_shown(seen, standing(moved), BONES)
    assert found is not None
    assert found.tolist() == [SHOWN, SHOWN, SHOWN]


def test_a_leg_that_a_mask_lacks_may_still_have_points() -> None:
    seen = see((320, 310), (320, 358), (400, 358))
    found = find_shown(seen, standing(mask_of(270, 60, 400, 310)), [])
    assert found is not None
    assert found.tolist() == [SHOWN, UNSEEN, OUTSIDE]
    seen = see((320, 318), (320, 358), (400, 358))
    found = find_shown(seen, standing(mask_of(270, 60, 400, 270)), BONES)
    assert found is not None
    assert found.tolist() == [UNSEEN, UNSEEN, OUTSIDE]


def test_a_shin_that_a_mask_lacks_between_knee_and_ankle_may_have_points() -> None:
    values = np.zeros((480, 640), dtype=np.uint8)
    values[60:290, 270:400] = values[355:370, 300:340] = 255
    seen = see((320, 322), (400, 322), (320, 362))
    found = find_shown(seen, standing(PersonMask.of_grid(values, (640, 480))), BONES)
    assert found is not None
    assert found.tolist() == [UNSEEN, OUTSIDE, SHOWN]


def test_a_neighbours_mask_is_not_believed() -> None:
    seen = see((320, 200), (500, 200))
    assert find_shown(seen, standing(mask_of(460, 60, 600, 370)), BONES) is None
    assert find_shown(seen, standing(mask_of(0, 0, 0, 0)), BONES) is None
    assert find_shown(seen, standing(None), BONES) is None
