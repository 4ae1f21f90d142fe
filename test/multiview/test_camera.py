# SPDX-License-Identifier: Apache-2.0
"""Cameras: projection by hand, the lens model's inverse, resizing, and refusal of unusable calibrations."""

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.camera import Camera

TURN = cv2.Rodrigues(np.array([0.3, -1.1, 0.4]))[0]
NO_LENS = [0.0] * 5


def camera(**changes: Any) -> Camera:
    fields: dict[str, Any] = {
        "k": [800.0, 0, 319.5, 0, 780.0, 239.5, 0, 0, 1],
        "d": NO_LENS,
        "width": 640,
        "height": 480,
        "rotation": np.eye(3),
        "translation": (0, 0, 0),
    }
    return Camera.from_info(**(fields | changes))


def test_project_is_the_pinhole_formula_and_knows_what_is_behind() -> None:
    pixels, depth = camera(translation=(0, 0, 1)).project([[0.5, -0.25, 3.0], [0, 0, -5.0]])
    assert pixels[0] == pytest.approx([800 * 0.5 / 4 + 319.5, -780 * 0.25 / 4 + 239.5])
    assert np.isnan(pixels[1]).all()
    assert depth == pytest.approx([4.0, -4.0])


def test_project_agrees_with_opencv() -> None:
    lens = np.array([-0.05, 0.14, 0.0006, 0.0007, 0.01])
    view = camera(d=lens, rotation=TURN, translation=(0.2, -0.1, 4.0))
    points = np.random.default_rng(0).normal(size=(50, 3)) * 0.6
    expected = cv2.projectPoints(points, cv2.Rodrigues(TURN)[0], view.translation, view.matrix, lens)[0][:, 0]
    np.testing.assert_allclose(view.project(points)[0], expected, atol=1e-8)


def test_rays_start_at_the_centre_and_meet_the_points() -> None:
    view = camera(d=[-0.1, 0.05, 0.001, -0.002, 0], rotation=TURN, translation=(0.2, -0.1, 4.0))
    points = np.random.default_rng(1).normal(size=(20, 3)) * 0.5
    rays = view.cast_rays(view.project(points)[0])
    assert view.project(view.centre)[1] == pytest.approx(0, abs=1e-12)
    along = points - view.centre
    np.testing.assert_allclose(rays, along / np.linalg.norm(along, axis=1)[:, None], atol=1e-9)


small = st.floats(-0.15, 0.15)
tangential = st.floats(-0.01, 0.01)


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(st.tuples(small, small, tangential, tangential, small), st.floats(-0.6, 0.6), st.floats(-0.6, 0.6))
def test_undistort_inverts_the_lens(lens: tuple[float, ...], x: float, y: float) -> None:
    view = camera(d=lens)
    pixels, _ = view.project([x, y, 1.0])
    np.testing.assert_allclose(view.undistort(pixels), [x, y], atol=1e-8)


def test_undistort_says_nan_beyond_the_lens_models_fold() -> None:
    # With k1 = -0.3 the distorted radius never exceeds 0.703: r (1 - 0.3 r^2) is largest at r = 1.054.
    plane = camera(d=[-0.3]).undistort([[319.5 + 800 * 0.6, 239.5], [319.5 + 800 * 0.8, 239.5]])
    assert np.isfinite(plane[0]).all() and plane[0, 0] < 1.054
    assert np.isnan(plane[1]).all()
    view = camera(d=[-0.3])
    assert np.sqrt(view.max_squared_radius) == pytest.approx(1.054, abs=2e-3)
    folded, seen = view.project([[1.8, 0.0, 1.0], [0.6, 0.0, 1.0]])[0]
    assert np.isnan(folded).all() and np.isfinite(seen).all()
    assert camera(d=[0.1, 0.05]).max_squared_radius == np.inf


@pytest.mark.parametrize("factor", [0.25, 0.5, 2.0, 0.3])
def test_scaled_follows_the_resized_image(factor: float) -> None:
    # A bright blob's centre of mass in the resized image is where the scaled camera puts it.
    view = camera()
    point = np.array([0.11, -0.07, 2.0])
    u, v = view.project(point)[0]
    rows, columns = np.mgrid[:480, :640]
    image = np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 12.0**2)).astype(np.float32)
    scaled = view.scale(factor)
    small = cv2.resize(image, scaled.size, interpolation=cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR)
    rows, columns = np.mgrid[: small.shape[0], : small.shape[1]]
    centre = np.array([(small * columns).sum(), (small * rows).sum()]) / small.sum()
    np.testing.assert_allclose(scaled.project(point)[0], centre, atol=0.02)


def test_short_distortion_is_filled_up_with_zeros() -> None:
    assert camera(d=[]).distortion.tolist() == NO_LENS
    assert camera(d=[0.1, 0.2, 0.3, 0.4]).distortion.tolist() == [0.1, 0.2, 0.3, 0.4, 0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"k": [0.0] * 9}, "uncalibrated"),
        ({"k": [1.0] * 8}, "9 finite numbers"),
        ({"k": [800.0, 0, 1, 0, -780, 1, 0, 0, 1]}, "not that of a pinhole"),
        ({"k": [np.nan] * 9}, "9 finite numbers"),
        ({"d": [0.1] * 8}, "up to 5"),
        ({"d": [np.inf]}, "up to 5"),
        ({"lens_model": "equidistant"}, "equidistant"),
        ({"width": 0}, "0 x 480"),
        ({"rotation": np.diag([1.0, 1, -1])}, "not a rotation matrix"),
        ({"rotation": np.zeros((3, 3))}, "not a rotation matrix"),
        ({"translation": (0, np.nan, 0)}, "3 finite numbers"),
    ],
)
def test_unusable_calibrations_are_refused_in_one_sentence(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        camera(**change)


def test_equals_sees_every_change() -> None:
    assert camera().equals(camera())
    assert not camera().equals(camera(translation=(0, 0, 1e-6)))
    assert not camera().equals(camera(d=[0.1]))
