# SPDX-License-Identifier: Apache-2.0
"""Depth images as image_transport's `compressedDepth` sends them: a header, then a PNG or RVL image of 16 bits.

The header is an enumeration and two floats a and b. A 32FC1 image is sent as inverse depth q, where the depth is
a / (q - b), and q is 0 where it is unknown; a 16UC1 image is sent unchanged. RVL (A. D. Wilson, Fast Lossless Depth
Image Compression, 2017) encodes runs of zeros and of differences in 32-bit words, here after width and height.
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

MAX_PIXELS = 100_000_000
"""Pixels of the largest image that is decoded; a larger size is wrong or hostile and would exhaust the memory."""

HEADER = struct.Struct("<iff")  # format, a, b
_PNG = b"\x89PNG\r\n\x1a\n"
_TRUNCATED = -1  # returned when the data ends early


def source_encoding(form: str) -> str:
    """Return the encoding of the image before compression, from a `format` such as `16UC1; compressedDepth png`."""
    return form.partition(";")[0].strip()


def is_compressed_depth(form: str) -> bool:
    """Return whether a message's `format` is compressedDepth, with or without the codec's name."""
    return "compresseddepth" in form.lower().replace(" ", "")


def decode_compressed_depth(message: Any) -> U16 | F32:
    """Return the image (H, W) of a `compressedDepth` message: 16UC1 as uint16, 32FC1 as float32 metres, NaN unknown.

    A 16UC1 image that was sent as a picture, by the transport `compressed` (`16UC1; png compressed`), is a PNG without
    a header. InputError if it is neither, if data is missing, or if it has more than MAX_PIXELS.
    """
    encoding, data = source_encoding(message.format), message_bytes(message.data)
    if not is_compressed_depth(message.format) and encoding.lower() in ("16uc1", "mono16"):
        return _decode_png(data)
    if not is_compressed_depth(message.format) or encoding.lower() not in ("16uc1", "mono16", "32fc1"):
        raise InputError(f"the format {message.format!r} is not that of a depth image of 16UC1 or 32FC1")
    if len(data) <= HEADER.size:
        raise InputError(f"a compressed depth image of {len(data)} bytes is empty")
    _, a, b = HEADER.unpack_from(data)
    body = data[HEADER.size :]
    pixels = _decode_png(body) if body[: len(_PNG)].tobytes() == _PNG else _decode_rvl(body)
    if encoding.lower() != "32fc1":
        return pixels
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.float32(a) / (pixels.astype(np.float32) - np.float32(b))
    return np.where(pixels > 0, depth, np.float32(np.nan))


def _decode_png(data: U8) -> U16:
    width, height = struct.unpack(">II", data[16:24].tobytes().ljust(8, b"\0"))
    _check_size(width, height)
    try:
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.dtype != np.uint16 or image.ndim != 2:
        raise InputError(f"a compressed depth image of {len(data)} bytes is not a whole 16-bit PNG")
    return np.asarray(image, np.uint16)


def _decode_rvl(data: U8) -> U16:
    if len(data) < 8:
        raise InputError(f"a compressed depth image of {len(data)} bytes is neither PNG nor RVL")
    width, height = struct.unpack_from("<II", data)
    _check_size(width, height)
    words = np.frombuffer(data[8 : len(data) - len(data) % 4].tobytes(), "<u4")
    pixels = np.zeros(width * height, np.uint16)
    if _decode_runs(words, pixels) == _TRUNCATED:
        raise InputError(f"an RVL depth image of {width}x{height} and {len(data)} bytes is not whole")
    return pixels.reshape(height, width)


def _check_size(width: int, height: int) -> None:
    if not 0 < width * height <= MAX_PIXELS:
        raise InputError(
            f"a compressed depth image of {width}x{height} is empty or larger than {MAX_PIXELS // 1_000_000} "
            "million pixels"
        )


@njit(cache=True, nogil=True)
def _read_number(words: NDArray[np.uint32], at: int) -> tuple[int, int]:
    """Return the number that starts at nibble `at` and the index after it; _TRUNCATED if the words end first."""
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
def _decode_runs(words: NDArray[np.uint32], pixels: U16) -> int:
    """Fill `pixels` (N,), all 0, from runs: count of zeros, count of others, then the zigzag difference of each."""
    at, done, last = 0, 0, 0
    while done < len(pixels):
        zeros, at = _read_number(words, at)
        if at == _TRUNCATED:
            return _TRUNCATED
        others, at = _read_number(words, at)
        if at == _TRUNCATED or zeros + others == 0 or done + zeros + others > len(pixels):
            return _TRUNCATED
        done += zeros
        for _ in range(others):
            code, at = _read_number(words, at)
            if at == _TRUNCATED:
                return _TRUNCATED
            last += (code >> 1) ^ -(code & 1)
            pixels[done] = last & 0xFFFF
            done += 1
    return done
