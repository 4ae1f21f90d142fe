# SPDX-License-Identifier: Apache-2.0
"""Images: every encoding to RGB, padding and byte order, labels, flow, and what cannot be decoded."""

import array
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages import images

FACTORY = BagMessageFactory()
HEADER = FACTORY.make("std_msgs/msg/Header", frame_id="cam")


def ramp(height: int = 12, width: int = 16) -> Any:
    """A smooth colour picture, so that subsampled and mosaic encodings lose little."""
    y, x = np.mgrid[:height, :width]
    return np.stack([40 + 8 * x, 60 + 6 * y, 200 - 5 * x], axis=2).astype(np.uint8)


def message(pixels: Any, encoding: Any, padding: int = 0, big: bool = False) -> Any:
    """A raw image message as a driver may send it: padded rows, data as array.array."""
    rows = np.ascontiguousarray(pixels).reshape(len(pixels), -1).view(np.uint8)
    padded = np.pad(rows, ((0, 0), (0, padding)), constant_values=99)
    return SimpleNamespace(
        header=HEADER,
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=int(big),
        step=padded.shape[1],
        data=array.array("B", padded.tobytes()),
    )


def test_packed_colours_come_back_exactly() -> None:
    rgb = ramp()
    alpha = np.dstack([rgb, np.full(rgb.shape[:2], 7, np.uint8)])
    for encoding, pixels in {
        "rgb8": rgb,
        "bgr8": rgb[:, :, ::-1],
        "8UC3": rgb[:, :, ::-1],
        "rgba8": alpha,
        "bgra8": alpha[:, :, [2, 1, 0, 3]],
    }.items():
        for padding in (0, 5):
            decoded = images.decode_image(message(pixels, encoding, padding))
            np.testing.assert_array_equal(decoded, rgb, err_msg=encoding)


@pytest.mark.parametrize("big", [False, True])
def test_grey_becomes_three_equal_channels(big: Any) -> None:
    grey = ramp()[:, :, 0]
    np.testing.assert_array_equal(images.decode_image(message(grey, "mono8", 3)), np.dstack([grey] * 3))
    deep = (grey.astype(np.uint16) << 8) + 17
    pixels = deep.astype(">u2" if big else "<u2")
    np.testing.assert_array_equal(images.decode_image(message(pixels, "mono16", 2, big)), np.dstack([grey] * 3))


@pytest.mark.parametrize(("encoding", "order"), [("yuv422", "uyvy"), ("yuv422_yuy2", "yuyv"), ("uyvy", "uyvy")])
def test_yuv422_packs_one_colour_for_two_pixels(encoding: Any, order: Any) -> None:
    rgb = ramp()
    yuv = cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV).astype(float)
    u, v = (yuv[:, 0::2, k] / 2 + yuv[:, 1::2, k] / 2 for k in (1, 2))
    columns = {"uyvy": (u, yuv[:, 0::2, 0], v, yuv[:, 1::2, 0]), "yuyv": (yuv[:, 0::2, 0], u, yuv[:, 1::2, 0], v)}
    packed = np.rint(np.stack(columns[order], axis=2)).astype(np.uint8).reshape(rgb.shape[0], rgb.shape[1], 2)
    decoded = images.decode_image(message(packed, encoding)).astype(int)
    # Full-range and video-range YUV differ by up to a tenth; a swapped U and V or Y differ by far more.
    assert np.abs(decoded - rgb).mean() < 14


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_mosaics_give_the_colours_back(pattern: Any) -> None:
    rgb = ramp()
    mosaic = np.zeros(rgb.shape[:2], np.uint8)
    for k, letter in enumerate(pattern):
        row, column = divmod(k, 2)
        mosaic[row::2, column::2] = rgb[row::2, column::2, "rgb".index(letter)]
    decoded = images.decode_image(message(mosaic, f"bayer_{pattern}8")).astype(int)
    assert np.abs(decoded - rgb)[2:-2, 2:-2].max() < 12


def test_compressed_images_are_rgb() -> None:
    rgb = ramp(16, 24)
    jpeg = FACTORY.make("sensor_msgs/msg/CompressedImage", format="jpeg", data=images.encode_jpeg(rgb, 98))
    assert np.abs(images.decode_image(jpeg).astype(int) - rgb).max() < 16
    png = cv2.imencode(".png", rgb[:, :, ::-1])[1].reshape(-1)
    lossless = FACTORY.make("sensor_msgs/msg/CompressedImage", format="png", data=png)
    np.testing.assert_array_equal(images.decode_image(lossless), rgb)


@pytest.mark.parametrize("data", [b"", b"no picture", bytes(1000)])
def test_broken_compressed_images_are_refused(data: Any) -> None:
    broken = FACTORY.make("sensor_msgs/msg/CompressedImage", format="jpeg", data=np.frombuffer(data, np.uint8))
    with pytest.raises(InputError, match=f"'jpeg' and {len(data)} bytes cannot be decoded"):
        images.decode_image(broken)


def test_half_a_colour_pair_is_refused() -> None:
    odd = message(np.zeros((12, 15, 2), np.uint8), "yuv422_yuy2")
    with pytest.raises(InputError, match="15x12 is not a whole yuv422_yuy2 image"):
        images.decode_image(odd)


def test_unknown_encodings_and_wrong_sizes_are_refused_by_name() -> None:
    with pytest.raises(InputError, match="the image encoding 'pixels9' is not one of rgb8"):
        images.decode_image(message(ramp(), "pixels9"))
    short = message(ramp(), "rgb8")
    short.data = short.data[:-1]
    with pytest.raises(InputError, match="16x12 rgb8 has step 48 and 575 bytes"):
        images.decode_image(short)


def test_labels_and_flow_come_back_exactly() -> None:
    labels = np.arange(30, dtype=np.uint8).reshape(5, 6)
    np.testing.assert_array_equal(images.decode_labels(images.make_image(FACTORY, HEADER, labels, "mono8")), labels)
    flow = np.random.default_rng(0).normal(size=(4, 7, 2)).astype(np.float32)
    flow[1, 2] = np.nan
    made = images.make_image(FACTORY, HEADER, flow, "32FC2")
    assert (made.step, made.is_bigendian) == (56, False)
    np.testing.assert_array_equal(images.decode_flow(made), flow)
    np.testing.assert_array_equal(images.decode_flow(message(flow.astype(">f4"), "32FC2", 4, big=True)), flow)
    with pytest.raises(InputError, match="32FC2"):
        images.decode_flow(images.make_image(FACTORY, HEADER, labels, "mono8"))
