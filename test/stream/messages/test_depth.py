# SPDX-License-Identifier: Apache-2.0
"""Depth images: units, unknown pixels, the optical frame, pairing with camera_info, what cannot be used."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.clouds import decode_cloud
from flowing_puppet_ros.stream.messages.depth import MAX_POINTS, back_project, make_depth_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header
from flowing_puppet_ros.stream.messages.images import decode_depth, make_image
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO, IMAGE
from flowing_puppet_ros.stream.pairing.depth_pairs import DepthPairs

FACTORY = BagMessageFactory()


def camera(width: int, height: int, stamp: int = 0, focal: float = 100.0, **fields: Any) -> Any:
    """Return the camera_info of a camera that looks along its axis."""
    k = np.array([focal, 0, (width - 1) / 2, 0, focal, (height - 1) / 2, 0, 0, 1.0])
    given = {"width": width, "height": height, "k": k, "p": np.zeros(12)} | fields
    return FACTORY.make(CAMERA_INFO, header=make_header(FACTORY, stamp, "depth_optical_frame"), **given)


def depth(pixels: Any, encoding: str, stamp: int = 0) -> Any:
    """Return a depth image."""
    return make_image(FACTORY, make_header(FACTORY, stamp, "depth_optical_frame"), np.asarray(pixels), encoding)


def test_both_encodings_give_metres_and_nan_where_unknown() -> None:
    millimetres = depth(np.array([[0, 1500], [65535, 1]], np.uint16), "16UC1")
    np.testing.assert_allclose(decode_depth(millimetres), [[np.nan, 1.5], [65.535, 0.001]], rtol=1e-6)
    metres = depth(np.array([[np.nan, 1.5], [-1, np.inf]], np.float32), "32FC1")
    np.testing.assert_array_equal(decode_depth(metres), np.array([[np.nan, 1.5], [np.nan, np.nan]], np.float32))
    with pytest.raises(InputError, match="depth must be 16UC1"):
        decode_depth(depth(np.zeros((2, 2), np.uint8), "mono8"))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.floats(20, 2000), st.integers(2, 30), st.integers(2, 40))
def test_points_project_back_to_their_pixels(seed: int, focal: float, height: int, width: int) -> None:
    z = np.random.default_rng(seed).uniform(0.3, 8, (height, width)).astype(np.float32)
    points = back_project(z, camera(width, height, focal=focal))
    assert len(points) == height * width
    u, v = points[:, 0] / points[:, 2] * focal + (width - 1) / 2, points[:, 1] / points[:, 2] * focal + (height - 1) / 2
    np.testing.assert_allclose(u, np.tile(np.arange(width), height), atol=1e-2)
    np.testing.assert_allclose(v, np.repeat(np.arange(height), width), atol=1e-2)
    np.testing.assert_array_equal(points[:, 2], z.ravel())


def test_the_projection_matrix_comes_before_the_camera_matrix() -> None:
    p = np.array([50.0, 0, 1, 0, 0, 50, 1, 0, 0, 0, 1, 0])
    points = back_project(np.ones((3, 3), np.float32), camera(3, 3, p=p))
    np.testing.assert_allclose(points[-1], [1 / 50, 1 / 50, 1], rtol=1e-6)


def test_a_large_image_is_thinned_evenly_and_unknown_pixels_are_left_out() -> None:
    z = np.full((1080, 1920), 2.0, np.float32)
    z[:, :960] = np.nan
    points = back_project(z, camera(1920, 1080))
    assert MAX_POINTS / 4 < len(points) <= MAX_POINTS
    assert (points[:, 0] > 0).all()


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"k": np.zeros(9)}, "uncalibrated"),
        ({"k": np.array([math.nan, 0, 1, 0, math.nan, 1, 0, 0, 1])}, "not those of a pinhole camera"),
        ({"size": (7, 3)}, "the depth image is 4x3, its camera_info says 7x3"),
    ],
)
def test_a_camera_info_that_does_not_fit_is_refused(fields: Any, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        back_project(np.ones((3, 4), np.float32), camera(*fields.pop("size", (4, 3)), **fields))


def test_pairs_are_made_by_stamp_in_any_order_and_never_wait_for_long() -> None:
    pairs = DepthPairs()
    image, later, last = (depth(np.ones((3, 4)), "32FC1", stamp) for stamp in (1, 2, 3))
    info, own = camera(4, 3, 1), camera(4, 3, 3)
    assert pairs.add("depth", image) == []
    assert pairs.add("camera_info", info) == [(image, info)]
    assert pairs.add("depth", later) == []
    assert pairs.add("camera_info", own) == []
    assert pairs.add("depth", last) == [(later, own), (last, own)], "the newest calibration stands in"
    assert pairs.add("depth", depth(np.ones((3, 4)), "32FC1", 4)) == []
    assert len(pairs.flush()) == 1


def test_the_cloud_has_the_header_of_the_image() -> None:
    image = depth(np.full((3, 4), 2.0, np.float32), "32FC1", 5)
    cloud = make_depth_cloud(FACTORY, image, camera(4, 3))
    assert cloud.header == image.header
    assert decode_cloud(cloud)[0].shape == (12, 3)
    with pytest.raises(InputError, match="no camera_info came yet"):
        make_depth_cloud(FACTORY, image, None)
    with pytest.raises(InputError, match="step"):
        make_depth_cloud(FACTORY, FACTORY.make(IMAGE, encoding="32FC1", width=4, height=3), camera(4, 3))
