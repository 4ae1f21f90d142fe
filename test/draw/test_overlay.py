# SPDX-License-Identifier: Apache-2.0
"""Puppets drawn over images."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.draw.overlay import DrawnPuppet, draw_puppets, spread
from flowing_puppet_ros.draw.palette import PART_COLOURS, joint_colour


def square(x: float, y: float, side: float) -> np.ndarray:
    return np.array([(x, y), (x + side, y), (x + side, y + side), (x, y + side)], float)


def puppet(**changes: Any) -> DrawnPuppet:
    values = {
        "id": "a1",
        "joint_names": ("left_wrist", "right_wrist"),
        "joints": np.array([[150.0, 30.0], [20.0, 30.0]]),
        "confidence": np.array([1.0, 1.0]),
        "part_names": ("torso", "left_lower_arm"),
        "contours": (square(40, 40, 60), square(80, 60, 40)),
        "order": (0, 1),
    }
    return DrawnPuppet(**(values | changes))


IMAGE = np.full((140, 200, 3), 50, np.uint8)


def test_parts_are_filled_in_depth_order() -> None:
    front = draw_puppets(IMAGE, [puppet()], opacity=1.0, labels=False)
    behind = draw_puppets(IMAGE, [puppet(order=(1, 0))], opacity=1.0, labels=False)
    assert tuple(front[80, 90]) == PART_COLOURS["left_lower_arm"]
    assert tuple(behind[80, 90]) == PART_COLOURS["torso"]
    assert tuple(front[50, 60]) == PART_COLOURS["torso"]
    assert (IMAGE == 50).all()


def test_opacity_mixes_the_part_with_the_image() -> None:
    drawn = draw_puppets(IMAGE, [puppet()], opacity=0.5, labels=False)
    expected = (np.array(PART_COLOURS["torso"]) + 50) / 2
    assert np.abs(drawn[55, 60] - expected).max() <= 1
    assert tuple(drawn[130, 190]) == (50, 50, 50)


def test_joints_show_side_and_confidence() -> None:
    sure = draw_puppets(IMAGE, [puppet()], labels=False)
    assert tuple(sure[30, 150]) == joint_colour("left_wrist")
    assert tuple(sure[30, 20]) == joint_colour("right_wrist")
    unsure = draw_puppets(IMAGE, [puppet(confidence=np.array([0.2, np.nan]))], labels=False)
    assert (unsure[30, 150] < 60).all() and (unsure[30, 20] < 60).all()


def test_unknown_joints_and_bad_contours_are_left_out() -> None:
    contours = (np.full((4, 2), np.nan), np.zeros((2, 2)))
    joints = np.array([[np.nan, 3.0], [np.inf, 2.0]])
    assert (draw_puppets(IMAGE, [puppet(contours=contours, joints=joints)]) == IMAGE).all()


def test_puppets_outside_the_image_and_grey_images() -> None:
    outside = puppet(contours=(square(-500, -500, 60), square(900, 900, 40)), joints=np.full((2, 2), -400.0))
    drawn = draw_puppets(IMAGE[..., 0], [outside], labels=False)
    assert drawn.shape == IMAGE.shape and (drawn == 50).all()
    assert (draw_puppets(IMAGE, []) == IMAGE).all()


def test_labels_write_beside_the_puppet() -> None:
    image, big = np.full((420, 600, 3), 50, np.uint8), puppet().transform(3)
    plain, labelled = (draw_puppets(image, [big], labels=flag) for flag in (False, True))
    changed = (plain != labelled).any(axis=2)
    assert changed[:, 380:].any() and changed[:, :110].any() and changed[:114].any()


def test_placed_keeps_pixel_centres() -> None:
    half = puppet().transform(0.5)
    assert half.joints[0] == pytest.approx([74.75, 14.75])  # (x + 0.5) / 2 - 0.5
    assert half.contours[0][0] == pytest.approx([19.75, 19.75])
    cropped = puppet().transform(1.0, (10, 20))
    assert cropped.joints[0] == pytest.approx([140, 10]) and cropped.contours[0][0] == pytest.approx([30, 20])


def test_small_puppets_get_their_id_alone() -> None:
    changed = (draw_puppets(IMAGE, [puppet()]) != draw_puppets(IMAGE, [puppet()], labels=False)).any(axis=2)
    assert changed[:38].any() and not changed[44:].any()


def test_from_message_sorts_the_parts_by_depth() -> None:
    message = SimpleNamespace(
        id="b2",
        joints=[SimpleNamespace(name="neck", x=1.0, y=2.0, confidence=0.5)],
        parts=[
            SimpleNamespace(name="torso", depth=2, contour=[0.0, 0.0, 1.0, 0.0, 1.0, 1.0]),
            SimpleNamespace(name="head", depth=0, contour=[5.0, 5.0]),
        ],
    )
    drawn = DrawnPuppet.from_message(message)
    assert drawn.order == (1, 0) and drawn.part_names == ("torso", "head")
    assert drawn.contours[0].shape == (3, 2) and drawn.joints.tolist() == [[1.0, 2.0]]
    empty = DrawnPuppet.from_message(SimpleNamespace(id="", joints=[], parts=[]))
    assert (draw_puppets(IMAGE, [empty]) == IMAGE).all()


def test_spread_keeps_order_gap_and_range() -> None:
    places = spread([5, 6, 7, 95], gap=10, low=0, high=100)
    assert np.diff(places).min() >= 10 - 1e-9
    assert spread([5, 40, 80], gap=10, low=0, high=100) == [5, 40, 80]
    assert spread([98, 99], gap=10, low=0, high=100) == [90, 100]
