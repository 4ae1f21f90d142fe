# SPDX-License-Identifier: Apache-2.0
"""Masks of people: where they are in the image, how far pixels are from them, and how they move."""

import numpy as np
import pytest

from flowing_puppet_ros.image.person_mask import PersonMask, label_people

SIZE = (320, 240)


def box(left: int, top: int, right: int, bottom: int, step: int = 1) -> PersonMask:
    """Return a mask of `step` px a cell that shows a box of pixels of an image of SIZE."""
    values = np.zeros((SIZE[1] // step, SIZE[0] // step), dtype=np.uint8)
    values[top // step : bottom // step, left // step : right // step] = 255
    return PersonMask.of_grid(values, SIZE)


@pytest.mark.parametrize("step", [1, 2, 4])
def test_distances_are_in_pixels_of_the_image(step: int) -> None:
    mask = box(100, 80, 200, 160, step)
    places = np.array([[150.0, 120.0], [220.0, 120.0], [150.0, 60.0], [np.nan, 0.0], [340.0, 120.0]])
    found = mask.measure_distance(places)
    np.testing.assert_allclose(found[[1, 2]], [20, 20], atol=step)
    assert found[0] == pytest.approx(-40, abs=step)
    assert np.isnan(found[3])
    assert found[4] == pytest.approx(140, abs=2 * step)  # outside of the image too
    assert mask.area == pytest.approx(100 * 80)


def test_an_empty_mask_is_infinitely_far() -> None:
    assert np.isinf(box(0, 0, 0, 0).measure_distance(np.zeros((2, 2)))).all()


def test_a_turned_grid_is_drawn_where_its_cells_are() -> None:
    # Columns of the grid lead down in the image, 2 px a cell, from (200, 40).
    values = np.zeros((50, 50), dtype=np.uint8)
    values[:10, :30] = 255
    mask = PersonMask(values, np.array([[0.0, -2.0, 200.0], [2.0, 0.0, 40.0]]))
    assert mask.cell == pytest.approx(2)
    drawn = mask.draw(SIZE, SIZE) >= 128
    rows, columns = np.nonzero(drawn)
    np.testing.assert_allclose([columns.min(), columns.max(), rows.min(), rows.max()], [181, 201, 39, 99], atol=1)
    inside = mask.measure_distance(np.array([[190.0, 60.0], [190.0, 130.0]]))
    assert inside[0] < 0 < inside[1]


def test_the_flow_carries_a_mask_and_unknown_flow_leaves_it() -> None:
    # Cells of 2 px: the person has moved by (16, -8) px before a background that stands still.
    forward = np.zeros((120, 160, 2), dtype=np.float32)
    forward[40:80, 50:100] = (8.0, -4.0)
    moved = box(100, 80, 200, 160).carry(forward, SIZE)
    places = np.array([[166.0, 112.0], [108.0, 112.0], [166.0, 156.0]])  # the middle, and what was uncovered
    found = moved.measure_distance(places)
    assert found[0] == pytest.approx(-40, abs=3)
    assert (found[1:] > 0).all()
    assert moved.area == pytest.approx(100 * 80, rel=0.05)
    unknown = np.full((120, 160, 2), np.nan, dtype=np.float32)
    still = box(100, 80, 200, 160).carry(unknown, SIZE)
    np.testing.assert_allclose(still.measure_distance(np.array([[150.0, 120.0]])), [-40], atol=3)


def test_a_moved_mask_has_moved_and_knows_less() -> None:
    moved = box(100, 80, 200, 160).move(np.array([20.0, -10.0]), 4.0)
    np.testing.assert_allclose(moved.measure_distance(np.array([[170.0, 110.0]])), [-40], atol=1)
    assert moved.slack == 4


def test_labels_are_of_whom_each_cell_shows_most_surely() -> None:
    first, second = box(100, 80, 200, 160), box(150, 80, 250, 160)
    weaker = PersonMask(second.values // 4 * 3, second.to_image)
    labels = label_people([None, first, weaker], (160, 120), SIZE)
    assert labels.shape == (120, 160)
    assert (labels[60, 55], labels[60, 90], labels[60, 110], labels[10, 10]) == (2, 2, 3, 0)
    assert label_people([], (160, 120), SIZE).max() == 0
