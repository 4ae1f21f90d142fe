# SPDX-License-Identifier: Apache-2.0
"""Canvases and cut-outs, and the way back from them to the image; poses in the mirror, and of one person twice."""

from collections.abc import Callable

import numpy as np
import pytest

from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.skeletons import COCO_17
from flowing_puppet_ros.image.networks.poses import (
    NetworkPose,
    Warp,
    as_pose,
    cut_rectangle,
    cut_square,
    drop_duplicates,
    fit_to_canvas,
    fit_to_rectangle,
    pose_distance,
)

type Cut = Callable[[np.ndarray], tuple[np.ndarray, Warp]]


def dot(size: tuple[int, int], place: tuple[float, float], radius: float) -> np.ndarray:
    """Return an image (width, height) with one soft dot, which may be between pixels."""
    x, y = np.meshgrid(*(np.arange(side) for side in size))
    grey = 255 * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * radius**2))
    return np.repeat(np.rint(grey).astype(np.uint8)[..., None], 3, axis=2)


def find_dot(image: np.ndarray) -> np.ndarray:
    """Return the centre of gravity (2,) px of an image's light."""
    light = image[..., 0].astype(float)
    x, y = np.meshgrid(*(np.arange(side) for side in light.shape[::-1]))
    return np.array([(light * x).sum(), (light * y).sum()]) / light.sum()


@pytest.mark.parametrize(
    ("size", "place", "radius", "side", "canvas_size"),
    [
        ((300, 200), (210.3, 60.0), 6.0, 128, (128, 96)),
        ((1001, 301), (700.0, 90.5), 20.0, 256, (256, 96)),
        ((30, 40), (21.0, 12.0), 2.0, 256, (192, 256)),
        ((256, 256), (200.0, 100.0), 3.0, 256, (256, 256)),
        ((1, 64), (0.0, 40.0), 3.0, 128, (32, 128)),
        ((2000, 3), (1400.0, 1.0), 50.0, 256, (256, 32)),
    ],
)
def test_a_dot_on_the_canvas_leads_back_to_its_place(
    size: tuple[int, int], place: tuple[float, float], radius: float, side: int, canvas_size: tuple[int, int]
) -> None:
    canvas, warp = fit_to_canvas(dot(size, place, radius), side)
    assert canvas.shape == (canvas_size[1], canvas_size[0], 3)
    np.testing.assert_allclose(warp.to_image(find_dot(canvas)), place, atol=0.5)


@pytest.mark.parametrize("angle", [0.0, 0.7, -2.1, np.pi])
@pytest.mark.parametrize(
    ("size", "place", "center", "half", "radius"),
    [
        ((300, 200), (120.0, 80.0), (130.0, 90.0), 60.0, 3.0),
        ((300, 200), (12.0, 14.5), (-10.0, -5.0), 60.0, 2.0),  # most of the square is outside
        ((901, 803), (420.0, 380.0), (430.0, 390.0), 300.0, 9.0),  # reduced by three
        ((901, 803), (860.0, 770.0), (430.0, 390.0), 900.0, 8.0),  # by nine; the image's sides are no multiples
        ((40, 30), (20.0, 11.0), (18.0, 12.0), 8.0, 1.5),  # enlarged
        ((12, 9), (6.0, 4.0), (6.0, 4.0), 400.0, 2.0),  # smaller than a pixel of the square's is of the image
    ],
)
def test_a_dot_in_a_square_leads_back_to_its_place(
    size: tuple[int, int],
    place: tuple[float, float],
    center: tuple[float, float],
    half: float,
    radius: float,
    angle: float,
) -> None:
    square, warp = cut_square(dot(size, place, radius), np.array(center), half, 192, angle)
    assert square.shape == (192, 192, 3)
    coarse = max(2 * half / 192, 1.0)
    np.testing.assert_allclose(warp.to_image(find_dot(square)), place, atol=0.5 if coarse < 5 else 0.5 * coarse)


def test_a_square_turned_clockwise_shows_upright_what_leans_clockwise() -> None:
    angle, center = 0.5, np.array([100.0, 100.0])
    head = center + 40 * np.array([np.sin(angle), -np.cos(angle)])
    square, _ = cut_square(dot((200, 200), tuple(head), 2.0), center, 64, 128, angle)
    np.testing.assert_allclose(find_dot(square), (63.5, 63.5 - 40), atol=0.5)


def test_outside_of_the_image_a_square_is_black() -> None:
    square, warp = cut_square(np.full((50, 50, 3), 200, np.uint8), np.array([0.0, 0.0]), 40.0, 80)
    inside = (warp.to_image(np.stack(np.meshgrid(np.arange(80), np.arange(80)), axis=-1)) >= 0).all(axis=-1)
    assert (square[inside] > 90).mean() > 0.99 and square[~inside].mean() < 5
    far, _ = cut_square(np.full((50, 50, 3), 200, np.uint8), np.array([1e4, 0.0]), 40.0, 80)
    assert not far.any()


@pytest.mark.parametrize("size", [(192, 256), (256, 192), (64, 64)])
def test_a_dot_in_a_rectangle_leads_back_to_its_place(size: tuple[int, int]) -> None:
    image = dot((640, 360), (400.0, 200.0), 8.0)
    whole, warp = fit_to_rectangle(image, size)
    assert whole.shape == (size[1], size[0], 3)
    np.testing.assert_allclose(warp.to_image(find_dot(whole)), (400, 200), atol=0.5)
    low, high = warp.to_image(np.array([[-0.5, -0.5], [size[0] - 0.5, size[1] - 0.5]]))
    assert (low <= -0.49).all() and (high >= (639.49, 359.49)).all(), "all of the image is in it"
    cut, warp = cut_rectangle(image, np.array([380.0, 210.0]), np.array([120.0, 150.0]), size)
    assert cut.shape == (size[1], size[0], 3)
    np.testing.assert_allclose(warp.to_image(find_dot(cut)), (400, 200), atol=0.5)
    low, high = warp.to_image(np.array([[-0.5, -0.5], [size[0] - 0.5, size[1] - 0.5]]))
    assert (low <= (320.5, 135.5)).all() and (high >= (439.5, 284.5)).all(), "all of the box is in it"
    assert np.ptp([low, high], axis=0)[0] / np.ptp([low, high], axis=0)[1] == pytest.approx(size[0] / size[1])


def standing(at: tuple[float, float] = (100.0, 50.0), width: float = 20.0, score: float = 0.8) -> NetworkPose:
    """Return somebody upright seen from the front, with shoulders `width` px wide; the left side is to the right."""
    heights = {"nose": -0.7, "eye": -0.8, "ear": -0.75, "shoulder": 0, "elbow": 0.8, "wrist": 1.5, "hip": 1.4,
               "knee": 2.6, "ankle": 3.7}  # fmt: skip
    spread = {"nose": 0, "eye": 0.1, "ear": 0.2, "shoulder": 0.5, "elbow": 0.7, "wrist": 0.75, "hip": 0.3,
              "knee": 0.3, "ankle": 0.3}  # fmt: skip
    joints = []
    for name in COCO_17:
        side, _, part = name.rpartition("_")
        joints.append((spread[part] * {"left": 1, "right": -1, "": 0}[side], heights[part]))
    return NetworkPose(np.array(joints) * width + at, np.linspace(0.5, 0.9, 17), score)


def test_in_the_mirror_left_is_right_and_twice_is_the_same() -> None:
    pose = standing()
    mirrored = pose.mirror(300)
    left, right = COCO_17.index("left_wrist"), COCO_17.index("right_wrist")
    np.testing.assert_allclose(mirrored.joints[left], (299 - pose.joints[right, 0], pose.joints[right, 1]))
    assert mirrored.scores[left] == pose.scores[right] and mirrored.joints[0, 0] == 299 - pose.joints[0, 0]
    again = mirrored.mirror(300)
    np.testing.assert_allclose(again.joints, pose.joints)
    np.testing.assert_array_equal(again.scores, pose.scores)
    np.testing.assert_array_equal(pose.exchange_sides().exchange_sides().joints, pose.joints)
    np.testing.assert_array_equal(pose.exchange_sides().joints[left], pose.joints[right])


def test_sizes_are_those_of_the_person() -> None:
    pose = standing(width=20.0)
    assert pose.size == pytest.approx(20) and pose.trunk == pytest.approx(28)
    sideways = NetworkPose(pose.joints * (0.05, 1), pose.scores, 0.8)
    assert sideways.size == pytest.approx(0.45 * 28), "from the side shoulders are as wide as the trunk tells"


def test_distance_is_the_median_in_shoulder_widths_of_joints_that_both_have() -> None:
    one, other = standing(), standing((110.0, 50.0))
    assert pose_distance(one, other) == pytest.approx(0.5)
    other.joints[9:] = np.nan
    assert pose_distance(one, other) == pytest.approx(0.5)
    assert pose_distance(standing(width=40.0), standing(width=20.0)) == pose_distance(
        standing(width=20.0), standing(width=40.0)
    )


def test_of_two_poses_in_one_place_the_more_certain_stays() -> None:
    near, far = standing((104.0, 50.0), score=0.9), standing((140.0, 50.0), score=0.3)
    assert drop_duplicates([standing(score=0.5), far, near]) == [near, far]
    assert drop_duplicates([]) == []


def test_a_known_person_is_a_pose_when_the_trunk_is_known() -> None:
    names = ("neck", *COCO_17)
    xy = np.vstack([(1.0, 2.0), standing().joints])
    pose = as_pose(Keypoints(names, xy, np.full(18, 0.7)))
    assert pose is not None
    np.testing.assert_array_equal(pose.joints, standing().joints)
    xy[1 + COCO_17.index("left_wrist")] = np.nan
    partial = as_pose(Keypoints(names, xy, np.full(18, 0.7)))
    assert partial is not None and np.isnan(partial.joints[COCO_17.index("left_wrist")]).all()
    xy[1 + COCO_17.index("left_hip")] = np.nan
    assert as_pose(Keypoints(names, xy, np.full(18, 0.7))) is None
    assert as_pose(Keypoints((), np.zeros((0, 2)), np.zeros(0))) is None
