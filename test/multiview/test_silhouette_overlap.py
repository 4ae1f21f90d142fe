# SPDX-License-Identifier: Apache-2.0
"""Rendered silhouettes against brute force and against a ball's; overlap and distance of outlines."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.rim_term import Outline
from flowing_puppet_ros.multiview.silhouette_overlap import (
    measure_outline_gap,
    measure_shares_inside,
    render_mask,
    silhouette_iou,
)

Ring = Callable[..., list[Camera]]
FLAT = Camera(np.eye(3), np.zeros(5), (20, 15), np.eye(3), np.zeros(3))


def disc(radius: float, shape: tuple[int, int] = (120, 120), centre: tuple[float, float] = (60, 60)) -> np.ndarray:
    rows, columns = np.indices(shape)
    return np.hypot(columns - centre[0], rows - centre[1]) <= radius


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.floats(-8, 28), st.floats(-8, 24)), min_size=3, max_size=3))
def test_a_triangle_covers_the_pixels_inside_it(corners: list[tuple[float, float]]) -> None:
    plane = np.array(corners)
    drawn = render_mask(FLAT, np.hstack([plane, np.ones((3, 1))]), np.array([[0, 1, 2]], np.int32))
    rows, columns = np.indices((15, 20))
    pixels = np.stack([columns, rows], axis=-1)
    sides = []
    for a, b in ((0, 1), (1, 2), (2, 0)):
        along, offset = plane[b] - plane[a], pixels - plane[a]
        sides.append(along[0] * offset[..., 1] - along[1] * offset[..., 0])
    inside = np.min(sides, axis=0) > 1e-6
    inside |= np.max(sides, axis=0) < -1e-6
    near = np.min(np.abs(sides), axis=0) <= 1e-6
    assert (drawn == inside)[~near].all()


def test_what_lies_behind_or_outside_is_not_drawn() -> None:
    faces = np.array([[0, 1, 2]], np.int32)
    square = np.array([[2.0, 2, 1], [10, 2, 1], [2, 10, 1]])
    assert render_mask(FLAT, square, faces).sum() > 30
    for scale, shift in (((1, 1, -1), (0, 0, 0)), ((1, 1, 1), (100, 0, 0)), ((1, 1, 1), (0, -100, 0))):
        assert not render_mask(FLAT, square * np.array(scale) + np.array(shift), faces).any()
    square[1, 2] = -1.0
    assert not render_mask(FLAT, square, faces).any(), "a face that reaches behind the camera"


def test_overlap_is_intersection_over_union() -> None:
    first, second = np.zeros((4, 5), bool), np.zeros((4, 5), bool)
    assert silhouette_iou(first, second) == 0
    first[0], second[0, 3:], second[1, 0] = True, True, True
    assert silhouette_iou(first, second) == pytest.approx(2 / 6)
    assert silhouette_iou(first, first) == 1


@pytest.mark.parametrize("shift", [0, 3, 8])
def test_the_gap_between_outlines_is_in_metres(shift: int) -> None:
    camera = Camera(np.diag([100.0, 100.0, 1.0]), np.zeros(5), (120, 120), np.eye(3), np.zeros(3))
    outline = Outline.of(camera, disc(30).astype(np.uint8))
    gap, squared = measure_outline_gap(disc(30 + shift), outline, 2.0)
    assert gap == pytest.approx(shift * 0.02, abs=0.01)
    assert squared == pytest.approx((shift * 0.02) ** 2, rel=0.1, abs=0.0003)
    assert np.isnan(measure_outline_gap(np.zeros((120, 120), bool), outline, 2.0)).all()


def test_shares_inside_fall_with_the_distance_outside(ring: Ring) -> None:
    camera = ring(4)[0]
    mask = np.zeros(camera.size[::-1], np.uint8)
    mask[100:220, 60:180] = 255
    outline = Outline.of(camera, mask)
    plane = np.array([(120.0, 160.0), (59.5, 160.0), (49.5, 160.0), (20.0, 160.0), (-500.0, 0.0)])
    points = camera.centre + 3 * camera.cast_rays(plane)
    shares = measure_shares_inside(points, [outline], 0.1)
    assert shares[0] == 1 and shares[4] == 0
    assert shares[1] == pytest.approx(1, abs=0.01) and shares[2] == pytest.approx(0.25, abs=0.03)
    assert shares[3] < 0.05
    both = measure_shares_inside(points, [outline, Outline.of(camera, 255 - mask)], 0.1)
    assert both[0] < 0.6, "what one view contradicts counts half"
