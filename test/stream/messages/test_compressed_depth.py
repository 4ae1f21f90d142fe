# SPDX-License-Identifier: Apache-2.0
"""`compressedDepth` images: both codecs and both encodings, and what is no such image."""

import struct
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.compressed_depth import MAX_PIXELS, decode_compressed_depth
from flowing_puppet_ros.stream.messages.images import decode_depth, decode_image


def rvl(pixels: np.ndarray) -> bytes:
    """Pack (H,W) uint16 as the paper says: written from it, one nibble at a time."""
    nibbles: list[int] = []

    def put(number: int) -> None:
        while True:
            low, number = number & 7, number >> 3
            nibbles.append(low | (8 if number else 0))
            if not number:
                return

    flat, at, last = pixels.ravel().astype(int).tolist(), 0, 0
    while at < len(flat):
        zeros = next((k for k, value in enumerate(flat[at:]) if value), len(flat) - at)
        put(zeros)
        at += zeros
        others = next((k for k, value in enumerate(flat[at:]) if not value), len(flat) - at)
        put(others)
        for value in flat[at : at + others]:
            put((value - last) << 1 if value >= last else ((last - value) << 1) - 1)
            last = value
        at += others
    nibbles += [0] * (-len(nibbles) % 8)
    words = [
        sum(nibble << (28 - 4 * k) for k, nibble in enumerate(nibbles[i : i + 8])) for i in range(0, len(nibbles), 8)
    ]
    return struct.pack(f"<II{len(words)}I", pixels.shape[1], pixels.shape[0], *words)


def png(pixels: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".png", pixels)[1])


def message(body: bytes, form: str = "16UC1; compressedDepth", a: float = 0.0, b: float = 0.0) -> Any:
    data = np.frombuffer(struct.pack("<iff", 0, a, b) + body, np.uint8)
    return SimpleNamespace(format=form, data=data)


images = arrays(
    np.uint16, st.tuples(st.integers(1, 12), st.integers(1, 12)), elements=st.sampled_from([0, 0, 1, 900, 65535])
)


@settings(max_examples=100, deadline=None)
@given(images, st.sampled_from([png, rvl]), st.sampled_from(["16UC1; compressedDepth", "16UC1; compressedDepth png"]))
def test_millimetres_come_back_as_they_were(pixels: np.ndarray, pack: Any, form: str) -> None:
    one = message(pack(pixels), form)
    np.testing.assert_array_equal(decode_compressed_depth(one), pixels)
    np.testing.assert_allclose(decode_depth(one), np.where(pixels > 0, pixels * 0.001, np.nan), rtol=1e-6)


@pytest.mark.parametrize("pack", [png, rvl])
def test_metres_come_back_from_inverse_depth(pack: Any) -> None:
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.4, 9.0, (30, 40)).astype(np.float32)
    depth[3, 4:9] = np.nan
    quantum, farthest = 100.0, 10.0
    a = quantum * (quantum + 1.0)
    b = 1.0 - a / farthest
    sent = np.where(np.isfinite(depth), a / np.nan_to_num(depth, nan=1.0) + b, 0.0).astype(np.uint16)
    found = decode_depth(message(pack(sent), "32FC1; compressedDepth rvl", a, b))
    assert np.isnan(found[3, 4:9]).all() and np.isfinite(found).sum() == depth.size - 5
    np.testing.assert_allclose(1 / found, 1 / depth, atol=1.01 / a)


@pytest.mark.parametrize(
    ("broken", "sentence"),
    [
        (message(b""), "is empty"),
        (message(b"abc"), "neither PNG nor RVL"),
        (message(png(np.ones((4, 5), np.uint16))[:-20]), "not a whole 16-bit PNG"),
        (message(png(np.ones((4, 5), np.uint8))), "not a whole 16-bit PNG"),
        (message(b"\x89PNG\r\n\x1a\n"), "0x0 is empty"),
        (message(struct.pack("<II", 1 << 20, MAX_PIXELS)), "larger than 100 million"),
        (message(rvl(np.full((9, 9), 7, np.uint16))[:-8]), "not whole"),
        (message(struct.pack("<III", 2, 2, 0)), "not whole"),
        (message(struct.pack("<III", 2, 2, 0x71000000)), "not whole"),
        (message(struct.pack("<III", 2, 2, 0xFFFFFFFF)), "not whole"),
        (message(png(np.ones((4, 5), np.uint16)), "jpeg"), "not that of a depth image"),
        (message(png(np.ones((4, 5), np.uint16)), "8UC3; compressedDepth"), "not that of a depth image"),
    ],
)
def test_what_is_no_depth_image_is_told_in_a_sentence(broken: Any, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        decode_depth(broken)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=60), st.integers(1, 9), st.integers(1, 9), st.sampled_from(["16UC1", "32FC1"]))
def test_any_bytes_are_an_image_or_a_sentence(body: bytes, width: int, height: int, encoding: str) -> None:
    one = message(struct.pack("<II", width, height) + body, f"{encoding}; compressedDepth rvl", np.nan, 1.0)
    try:
        depth = decode_depth(one)
    except InputError as error:
        assert "not whole" in str(error)
    else:
        assert depth.shape == (height, width) and not (depth <= 0).any()


def test_a_depth_image_is_no_picture() -> None:
    with pytest.raises(InputError, match="depth image, not a picture"):
        decode_image(message(png(np.ones((4, 5), np.uint16))))
