# SPDX-License-Identifier: Apache-2.0
"""Depth images as image_transport's `compressedDepth` sends them: a header, then a PNG or RVL image of 16 bits.

The header is an enumeration and two floats a and b. An image that was 32FC1 is sent as inverse depth q, from which its
depth is a / (q - b), and 0 where it is unknown; one that was 16UC1 is sent as it was. RVL (A. D. Wilson: Fast Lossless
Depth Image Compression, 2017) has runs of zeros and of differences in words of 32 bits, here after width and height.
"""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from flowing_puppet_ros.arrays import F32, U8, U16
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.message_types import message_bytes

LARGEST_PIXELS = 100_000_000
"""Pixels of the largest image that is decoded; sizes beyond are lies or mistakes, and would take the memory."""

HEADER = struct.Struct("<iff")
_PNG = b"\x89PNG\r\n\x1a\n"
_TRUNCATED = -1


def sent_encoding(form: str) -> str:
    """Return the encoding of the image that was compressed, of a `format` such as `16UC1; compressedDepth png`."""
    return form.partition(";")[0].strip()


def is_compressed_depth(form: str) -> bool:
    """Whether a message's `format` is that of a depth image: "compressedDepth" with or without the codec's name."""
    return "compresseddepth" in form.lower().replace(" ", "")


def unpack_depth(message: Any) -> U16 | F32:
    """Return the (H,W) image of a `compressedDepth` message: uint16 of 16UC1, float32 in metres, NaN unknown, of 32FC1.

    InputError in one sentence when it is none, when data is missing, or when it names more than LARGEST_PIXELS.
    """
    encoding, data = sent_encoding(message.format), message_bytes(message.data)
    if not is_compressed_depth(message.format) or encoding.lower() not in ("16uc1", "mono16", "32fc1"):
        raise InputError(f"the format {message.format!r} is not that of a depth image of 16UC1 or 32FC1")
    if len(data) <= HEADER.size:
        raise InputError(f"a compressed depth image of {len(data)} bytes is empty")
    _, a, b = HEADER.unpack_from(data)
    body = data[HEADER.size :]
    pixels = _png(body) if body[: len(_PNG)].tobytes() == _PNG else _rvl(body)
    if encoding.lower() != "32fc1":
        return pixels
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.float32(a) / (pixels.astype(np.float32) - np.float32(b))
    return np.where(pixels > 0, depth, np.float32(np.nan))


def _png(data: U8) -> U16:
    width, height = struct.unpack(">II", data[16:24].tobytes().ljust(8, b"\0"))
    _check_size(width, height)
    try:
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.dtype != np.uint16 or image.ndim != 2:
        raise InputError(f"a compressed depth image of {len(data)} bytes is no whole PNG of 16 bits")
    return np.asarray(image, np.uint16)


def _rvl(data: U8) -> U16:
    if len(data) < 8:
        raise InputError(f"a compressed depth image of {len(data)} bytes is neither PNG nor RVL")
    width, height = struct.unpack_from("<II", data)
    _check_size(width, height)
    words = np.frombuffer(data[8 : len(data) - len(data) % 4].tobytes(), "<u4")
    pixels = np.zeros(width * height, np.uint16)
    if _unroll(words, pixels) == _TRUNCATED:
        raise InputError(f"an RVL depth image of {width}x{height} and {len(data)} bytes is not whole")
    return pixels.reshape(height, width)


def _check_size(width: int, height: int) -> None:
    if not 0 < width * height <= LARGEST_PIXELS:
        raise InputError(
            f"a compressed depth image of {width}x{height} is empty or larger than {LARGEST_PIXELS // 1_000_000} "
            "million pixels"
        )


@njit(cache=True, nogil=True)
def _number(words: NDArray[np.uint32], at: int) -> tuple[int, int]:
    """The number whose first nibble has the index `at`, and the index after its last; _TRUNCATED if words end first."""
    value = 0
    for k in range(11):
        if at >= 8 * len(words):
            break
        nibble = (int(words[at // 8]) >> (28 - 4 * (at % 8))) & 15
        at += 1
        value |= (nibble & 7) << (3 * k)
        if nibble < 8:
            return value, at
    return 0, _TRUNCATED


@njit(cache=True, nogil=True)
def _unroll(words: NDArray[np.uint32], pixels: U16) -> int:
    """Fill `pixels` (N,), which are 0, from runs: so many zeros, so many others, each others' zigzag difference."""
    at, done, last = 0, 0, 0
    while done < len(pixels):
        zeros, at = _number(words, at)
        if at == _TRUNCATED:
            return _TRUNCATED
        others, at = _number(words, at)
        if at == _TRUNCATED or zeros + others == 0 or done + zeros + others > len(pixels):
            return _TRUNCATED
        done += zeros
        for _ in range(others):
            code, at = _number(words, at)
            if at == _TRUNCATED:
                return _TRUNCATED
            last += (code >> 1) ^ -(code & 1)
            pixels[done] = last & 0xFFFF
            done += 1
    return done
