# SPDX-License-Identifier: Apache-2.0
"""Images of a part of the sensor, and binned ones: points of space land on the pixels that they have there."""

from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.depth_topics import find_info
from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.camera_info import describe_images
from flowing_puppet_ros.stream.messages.depth import back_project_image
from flowing_puppet_ros.stream.messages.geometry import make_header
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO

FACTORY = BagMessageFactory()
K = np.array([100.0, 0, 31.5, 0, 120, 23.5, 0, 0, 1])
P = np.array([90.0, 0, 30, -9, 0, 95, 22, 0, 0, 0, 1, 0])  # a baseline in it
SIZE = 64, 48


def info(window: tuple[int, int, int, int] = (0, 0, 0, 0), bins: tuple[int, int] = (0, 0), **fields: Any) -> Any:
    """Return the camera_info of a sensor of 64x48; `window` is x, y, width, height."""
    x, y, width, height = window
    roi = FACTORY.make("sensor_msgs/msg/RegionOfInterest", x_offset=x, y_offset=y, width=width, height=height)
    given = {"width": SIZE[0], "height": SIZE[1], "k": K, "p": P, "roi": roi} | fields
    return FACTORY.make(
        CAMERA_INFO, header=make_header(FACTORY, 0, "eye"), binning_x=bins[0], binning_y=bins[1], **given
    )


@pytest.mark.parametrize(
    ("window", "bins", "size"),
    [
        ((0, 0, 0, 0), (2, 2), (32, 24)),
        ((10, 4, 40, 30), (1, 1), (40, 30)),
        ((10, 4, 40, 30), (2, 1), (20, 30)),
    ],
)
def test_pixels_of_the_images(window: Any, bins: Any, size: tuple[int, int]) -> None:
    """Pixel (u, v) of the whole sensor is ((u - x) / bin_x, (v - y) / bin_y) of the images."""
    whole = info(window, bins)
    described = describe_images(whole)
    assert (described.width, described.height) == size
    assert (whole.width, whole.roi.x_offset, whole.binning_x) == (64, window[0], bins[0]), "the message is left alone"
    point = np.array([0.3, -0.2, 2.0, 1.0])
    for before, after, columns in ((whole.k, described.k, 3), (whole.p, described.p, 4)):
        there, here = (np.reshape(matrix, (3, columns)) @ point[:columns] for matrix in (before, after))
        wanted = (there[:2] / there[2] - window[:2]) / np.maximum(bins, 1)
        np.testing.assert_allclose(here[:2] / here[2], wanted)
    assert describe_images(described) is described


def test_depth_of_a_window_lies_where_that_of_the_whole_image_does() -> None:
    depth = np.random.default_rng(0).uniform(1, 3, (SIZE[1], SIZE[0])).astype(np.float32)
    whole = back_project_image(depth, info())
    np.testing.assert_allclose(
        back_project_image(depth[4:34, 10:50], info((10, 4, 40, 30))), whole[4:34, 10:50], atol=1e-5
    )
    # Binned without averaging: the first of two pixels.
    binned = back_project_image(depth[::2, ::2], info(bins=(2, 2)))
    np.testing.assert_allclose(binned, whole[::2, ::2], atol=1e-5)


def test_drivers_that_write_the_size_of_the_images_or_none() -> None:
    depth = np.ones((SIZE[1], SIZE[0]), np.float32)
    plain = back_project_image(depth, info())
    np.testing.assert_array_equal(back_project_image(depth, info(bins=(2, 2))), plain)
    np.testing.assert_array_equal(back_project_image(depth, info(width=0, height=0)), plain)
    with pytest.raises(InputError, match=r"32x48, its camera_info says 64x48: publish the camera_info of these images"):
        back_project_image(depth[:, ::2], info())


def test_a_binned_camera_info_elsewhere_belongs_to_the_images() -> None:
    infos = {"/a/camera_info": info(), "/b/camera_info": info(bins=(2, 2))}
    assert find_info("/c/depth", "eye", (32, 24), infos) == "/b/camera_info"
