# SPDX-License-Identifier: Apache-2.0
"""Depth order and label images."""

import numpy as np
import pytest

from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.render import depth_order, render_labels


def square(left: float, top: float, side: float) -> np.ndarray:
    return np.array([[left, top], [left + side, top], [left + side, top + side], [left, top + side]])


@pytest.mark.parametrize("parts", [10, 14])
def test_arms_hide_the_head_which_hides_the_torso_which_hides_the_legs(parts: int) -> None:
    model = DeformableStructures.load("neutral", parts)
    order = depth_order(model, "front")
    assert sorted(order) == list(range(parts))
    names = [model.tree.names[part] for part in order]
    wanted = ["left_lower_leg", "torso", "head", "right_upper_arm", "left_upper_arm", "right_lower_arm"]
    assert [name for name in names if name in wanted] == wanted
    assert depth_order(model, "back") == order[::-1]


def test_nearer_parts_are_painted_over_farther_ones() -> None:
    contours = [square(0, 0, 9), square(5, 5, 9)]
    front = render_labels(contours, (0, 1), (20, 20))
    back = render_labels(contours, (1, 0), (20, 20))
    assert front.dtype == np.uint8
    assert (front[7, 7], back[7, 7]) == (2, 1)
    assert (front[2, 2], front[12, 12], front[18, 2]) == (1, 2, 0)
    np.testing.assert_array_equal(front > 0, back > 0)


def test_contours_outside_the_image_are_clipped() -> None:
    labels = render_labels([square(-1e9, -1e9, 2e9), square(100, 100, 5)], (0, 1), (8, 12))
    assert (labels == 1).all()
