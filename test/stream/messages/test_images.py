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
        "argb8": alpha[:, :, [3, 0, 1, 2]],
        "abgr8": alpha[:, :, [3, 2, 1, 0]],
    }.items():
        for padding in (0, 5):
            decoded = images.decode_image(message(pixels, encoding, padding))
            np.testing.assert_array_equal(decoded, rgb, err_msg=encoding)
        left_out = message(pixels, encoding)
        left_out.step = 0
        np.testing.assert_array_equal(images.decode_image(left_out), rgb, err_msg=encoding)


def test_a_shared_image_is_decoded_once_while_it_is_kept() -> None:
    shelf = images.SharedImages(max_images=2)
    pictures = [ramp() + k for k in range(3)]
    first, *others = [shelf.share(message(picture, "rgb8"), readers=4) for picture in pictures]
    decoded = images.decode_image(first)
    np.testing.assert_array_equal(decoded, pictures[0])
    assert first.header is HEADER
    assert images.decode_image(first) is decoded
    for other, picture in zip(others, pictures[1:], strict=True):
        np.testing.assert_array_equal(images.decode_image(other), picture)
    again = images.decode_image(first)
    assert again is not decoded, "two newer ones are kept in its place"
    np.testing.assert_array_equal(again, decoded)
    assert images.decode_image(first) is again, "its last reader"
    assert images.decode_image(first) is not again
    broken = shelf.share(message(pictures[0], "no encoding"), readers=2)
    for _ in range(2):
        with pytest.raises(InputError, match="no encoding"):
            images.decode_image(broken)


@pytest.mark.parametrize("big", [False, True])
def test_grey_becomes_three_equal_channels(big: Any) -> None:
    grey = ramp()[:, :, 0]
    np.testing.assert_array_equal(images.decode_image(message(grey, "mono8", 3)), np.dstack([grey] * 3))
    deep = (grey.astype(np.uint16) << 8) + 17
    pixels = deep.astype(">u2" if big else "<u2")
    np.testing.assert_array_equal(images.decode_image(message(pixels, "mono16", 2, big)), np.dstack([grey] * 3))


@pytest.mark.parametrize(("encoding", "order"), [("yuv422", "uyvy"), ("yuv422_yuy2", "yuyv"), ("yuv422_uyvy", "uyvy")])
def test_yuv422_packs_one_colour_for_two_pixels(encoding: Any, order: Any) -> None:
    rgb = ramp()
    yuv = cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV).astype(float)
    u, v = (yuv[:, 0::2, k] / 2 + yuv[:, 1::2, k] / 2 for k in (1, 2))
    columns = {"uyvy": (u, yuv[:, 0::2, 0], v, yuv[:, 1::2, 0]), "yuyv": (yuv[:, 0::2, 0], u, yuv[:, 1::2, 0], v)}
    packed = np.rint(np.stack(columns[order], axis=2)).astype(np.uint8).reshape(rgb.shape[0], rgb.shape[1], 2)
    decoded = images.decode_image(message(packed, encoding)).astype(int)
    # Full-range and video-range YUV differ by up to a tenth; a swapped U and V or Y differ by far more.
    assert np.abs(decoded - rgb).mean() < 14


def planes_of(rgb: Any) -> Any:
    """Return Y, U, V (H, W) of the video range (BT.601), by its definition."""
    r, g, b = (rgb[:, :, k].astype(float) for k in range(3))
    y = 16 + (65.738 * r + 129.057 * g + 25.064 * b) / 256
    u = 128 + (-37.945 * r - 74.494 * g + 112.439 * b) / 256
    v = 128 + (112.439 * r - 94.154 * g - 18.285 * b) / 256
    return (np.rint(plane).astype(np.uint8) for plane in (y, u, v))


@pytest.mark.parametrize(
    ("encoding", "order"),
    [("yuyv", "yuyv"), ("YUY2", "yuyv"), ("yuv422_yuy2", "yuyv"), ("uyvy", "uyvy"), ("yvyu", "yvyu"), ("2vuy", "uyvy")],
)
def test_packed_yuv_comes_back_to_a_few_levels(encoding: Any, order: Any) -> None:
    rgb = ramp()
    y, u, v = planes_of(rgb)
    ys = iter((y[:, 0::2], y[:, 1::2]))
    columns = [next(ys) if letter == "y" else (u if letter == "u" else v)[:, ::2] for letter in order]
    packed = np.stack(columns, axis=2).reshape(rgb.shape[0], rgb.shape[1], 2)
    for padding in (0, 6):
        decoded = images.decode_image(message(packed, encoding, padding)).astype(int)
        assert np.abs(decoded - rgb).max() < 16 and np.abs(decoded - rgb).mean() < 4


def planar(encoding: str, rgb: Any, padding: int = 0) -> Any:
    """Return a message of semi-planar or planar YUV."""
    y, u, v = planes_of(rgb)
    if encoding in ("nv21", "nv61", "nv42", "yv12"):
        u, v = v, u
    down, across = {"nv16": (1, 2), "nv61": (1, 2), "nv24": (1, 1), "nv42": (1, 1)}.get(encoding, (2, 2))
    u, v = u[::down, ::across], v[::down, ::across]

    def padded(plane: Any, bytes_more: int) -> bytes:
        return bytes(np.pad(plane, ((0, 0), (0, bytes_more)), constant_values=200).tobytes())

    data = padded(y, padding)
    if encoding.startswith("nv"):
        both = np.stack([u, v], axis=2).reshape(len(u), -1)
        data += padded(both, padding * both.shape[1] // y.shape[1])
    else:
        data += padded(u, padding // 2) + padded(v, padding // 2)
    made = message(y, encoding)
    made.step += padding
    made.data = array.array("B", data)
    return made


PLANAR = ["nv12", "nv21", "nv16", "nv61", "nv24", "nv42", "i420", "yuv420", "yv12"]


@pytest.mark.parametrize("encoding", PLANAR)
def test_planar_yuv_comes_back_to_a_few_levels(encoding: str) -> None:
    rgb = ramp()
    for padding in (0, 8):
        decoded = images.decode_image(planar(encoding, rgb, padding)).astype(int)
        assert np.abs(decoded - rgb).max() < 20 and np.abs(decoded - rgb).mean() < 4
    # U and V the other way round would be seen.
    swapped = {"nv12": "nv21", "nv16": "nv61", "nv24": "nv42", "i420": "yv12", "yuv420": "yv12"}
    other = planar(encoding, rgb)
    other.encoding = swapped.get(encoding, next((a for a, b in swapped.items() if b == encoding), ""))
    assert np.abs(images.decode_image(other).astype(int) - rgb).mean() > 20


@pytest.mark.parametrize("encoding", ["nv12", "i420"])
def test_planar_yuv_is_read_whatever_height_and_step_count(encoding: str) -> None:
    rgb = ramp()
    right = images.decode_image(planar(encoding, rgb))
    counted = planar(encoding, rgb)
    counted.step = counted.step * 3 // 2
    np.testing.assert_array_equal(images.decode_image(counted), right)
    counted = planar(encoding, rgb)
    counted.height = counted.height * 3 // 2
    np.testing.assert_array_equal(images.decode_image(counted), right)


@pytest.mark.parametrize("encoding", PLANAR)
def test_planar_yuv_that_is_not_whole_is_refused(encoding: str) -> None:
    short = planar(encoding, ramp(10, 16))
    short.data = short.data[:-1]
    odd = planar(encoding, ramp(10, 16))
    odd.width, odd.step = 15, 15
    for bad in (short, odd):
        with pytest.raises(InputError, match=f"is not a whole {encoding} image"):
            images.decode_image(bad)


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_deep_greys_and_mosaics_use_all_their_bits(bits: int) -> None:
    grey = ramp()[:, :, 0]
    deep = (grey.astype(np.uint16) << (bits - 8)) + 1
    np.testing.assert_array_equal(images.decode_image(message(deep, f"mono{bits}")), np.dstack([grey] * 3))
    flat = np.full((6, 8), (90 << (bits - 8)) + 3, np.uint16)
    assert (images.decode_image(message(flat, f"bayer_rggb{bits}")) == 90).all()


def test_files_in_raw_images_are_read() -> None:
    rgb = ramp(16, 24)
    png = message(cv2.imencode(".png", rgb[:, :, ::-1])[1].reshape(1, -1), "png")
    np.testing.assert_array_equal(images.decode_image(png), rgb)
    jpeg = message(images.encode_jpeg(rgb, 98).reshape(1, -1), "jpeg")
    assert np.abs(images.decode_image(jpeg).astype(int) - rgb).max() < 16


@pytest.mark.parametrize("form", ["h264", "H.265", "hevc", "h264; yuv420p", "vp9", "av1"])
def test_video_is_named_with_the_way_out(form: str) -> None:
    data = np.frombuffer(b"\0\0\0\1\x67", np.uint8)
    video = FACTORY.make("sensor_msgs/msg/CompressedImage", format=form, data=data)
    with pytest.raises(InputError, match=f"'{form}' is video, whose images need those before them"):
        images.decode_image(video)


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


@pytest.mark.parametrize("suffix", ["png", "webp", "bmp", "tiff"])
def test_compressed_images_are_known_by_their_content(suffix: str) -> None:
    rgb = ramp(16, 24)
    options = [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == "webp" else []  # above 100: lossless
    data = cv2.imencode(f".{suffix}", rgb[:, :, ::-1], options)[1].reshape(-1)
    for form in (suffix, "", "rgb8; something compressed bgr8"):
        found = images.decode_image(FACTORY.make("sensor_msgs/msg/CompressedImage", format=form, data=data))
        np.testing.assert_array_equal(found, rgb)


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
