# SPDX-License-Identifier: Apache-2.0
"""Images to and from ROS messages: raw, compressed, label and flow images (REP-118 and sensor_msgs/image_encodings)."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable
from threading import Lock
from typing import Any

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F32, U8, Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.compressed_depth import MAX_PIXELS, decode_compressed_depth, is_compressed_depth
from flowing_puppet_ros.stream.messages.message_types import MessageFactory, message_bytes

JPEG_QUALITY = 85  # of compressed outputs, 0 to 100

MAX_FLOW_PX = 1e5
"""Maximum displacement in pixels; no flow is larger than images are wide."""

# encoding -> (channels, bits per channel, OpenCV conversion to RGB); 9 to 16 bits are the low ones of two bytes
_RAW: dict[str, tuple[int, int, int | None]] = {
    "rgb8": (3, 8, None),
    "bgr8": (3, 8, cv2.COLOR_BGR2RGB),
    "8uc3": (3, 8, cv2.COLOR_BGR2RGB),
    "rgba8": (4, 8, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, 8, cv2.COLOR_BGRA2RGB),
    "argb8": (4, 8, None),
    "abgr8": (4, 8, None),
    "8uc4": (4, 8, cv2.COLOR_BGRA2RGB),
    "mono8": (1, 8, cv2.COLOR_GRAY2RGB),
    "8uc1": (1, 8, cv2.COLOR_GRAY2RGB),
    "rgb16": (3, 16, None),
    "bgr16": (3, 16, cv2.COLOR_BGR2RGB),
    "16uc3": (3, 16, cv2.COLOR_BGR2RGB),
    "rgba16": (4, 16, cv2.COLOR_RGBA2RGB),
    "bgra16": (4, 16, cv2.COLOR_BGRA2RGB),
    "16uc4": (4, 16, cv2.COLOR_BGRA2RGB),
    **{f"mono{bits}": (1, bits, cv2.COLOR_GRAY2RGB) for bits in (10, 12, 14, 16)},
    **dict.fromkeys(("yuv422", "yuv422_uyvy", "uyvy", "uyvy422", "2vuy"), (2, 8, cv2.COLOR_YUV2RGB_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv", "yuyv422", "yuy2"), (2, 8, cv2.COLOR_YUV2RGB_YUY2)),
    "yvyu": (2, 8, cv2.COLOR_YUV2RGB_YVYU),
    **{
        f"bayer_{pattern.lower()}{bits}": (1, bits, getattr(cv2, f"COLOR_Bayer{pattern}2RGB"))
        for pattern in ("RGGB", "BGGR", "GBRG", "GRBG")
        for bits in (8, 10, 12, 14, 16)
    },
}
# encoding -> (bytes of the planes of colour per pixel, OpenCV conversion of the 4:2:0 layout to RGB)
_PLANAR: dict[str, tuple[float, int]] = {
    "nv12": (0.5, cv2.COLOR_YUV2RGB_NV12),
    "nv21": (0.5, cv2.COLOR_YUV2RGB_NV21),
    "nv16": (1, cv2.COLOR_YUV2RGB_NV12),
    "nv61": (1, cv2.COLOR_YUV2RGB_NV21),
    "nv24": (2, cv2.COLOR_YUV2RGB_NV12),
    "nv42": (2, cv2.COLOR_YUV2RGB_NV21),
    **dict.fromkeys(("i420", "iyuv", "yuv420", "yuv420p"), (0.5, cv2.COLOR_YUV2RGB_I420)),
    "yv12": (0.5, cv2.COLOR_YUV2RGB_YV12),
}
_FILES = ("jpeg", "jpg", "mjpeg", "png")
"""Encodings of raw images whose data is a file of that kind."""
_VIDEO_NAMES = {
    "h264": r"h\.?264|x264|avc1?",
    "hevc": r"h\.?265|x265|hevc",
    "vp8": "vp8",
    "vp9": "vp9",
    "av1": "av1",
    "mpeg4": "mpeg-?4",
}
"""Codec of FFmpeg -> how formats name it."""
_VIDEO = {codec: re.compile(rf"(?<![a-z0-9])(?:{names})(?![0-9])") for codec, names in _VIDEO_NAMES.items()}
# encoding -> (type of a pixel, metres per unit); some drivers call millimetres mono16 (REP-118 has the other two)
_DEPTH = {"16uc1": ("u2", 0.001), "mono16": ("u2", 0.001), "32fc1": ("f4", 1.0)}


class SharedImages:
    """Images that several components decode: once for all, while they are among the newest `max_images`."""

    def __init__(self, max_images: int) -> None:
        """Keep at most `max_images` decoded images."""
        self._max_images = max_images
        self._kept: deque[SharedImage] = deque()

    def share(self, message: Any, readers: int) -> SharedImage:
        """Return an image message in a form that `decode_image` decodes once for that many readers."""
        return SharedImage(message, readers, self._keep)

    def _keep(self, image: SharedImage) -> None:
        self._kept.append(image)
        if len(self._kept) > self._max_images:
            self._kept.popleft().forget()


class SharedImage:
    """An image message whose pixels are kept from its first reader to its last; nobody may change them."""

    def __init__(self, message: Any, readers: int, keep: Callable[[SharedImage], None]) -> None:
        """Wrap a message; `keep` is called with every image that holds pixels from now on."""
        self.header = message.header
        self._message, self._readers, self._keep = message, readers, keep
        self._pixels: U8 | None = None
        self._lock = Lock()

    def decode(self) -> U8:
        """Return the RGB image (H, W, 3); InputError when it cannot be decoded."""
        with self._lock:
            pixels = self._pixels
            if pixels is None:
                self._pixels = pixels = decode_image(self._message)
                self._keep(self)
            self._readers -= 1
            if self._readers <= 0:
                self.forget()
            return pixels

    def forget(self) -> None:
        """Drop the pixels; who wants them decodes them again."""
        self._pixels = None


def decode_image(message: Any) -> U8:
    """Return the RGB image (H, W, 3) of an Image or a CompressedImage; InputError when it cannot be decoded."""
    if isinstance(message, SharedImage):
        return message.decode()
    if hasattr(message, "format"):
        return _decode_compressed(message)
    encoding = message.encoding.lower().strip()
    if encoding in _FILES:
        return _decode_file(message_bytes(message.data), message.encoding)
    if encoding in _PLANAR:
        return _decode_planar(message, *_PLANAR[encoding])
    if encoding not in _RAW:
        raise InputError(f"the image encoding {message.encoding!r} is not one of {', '.join((*_RAW, *_PLANAR))}")
    channels, bits, conversion = _RAW[encoding]
    pixels = _read_rows(message, channels, np.dtype("u1" if bits == 8 else ">u2" if message.is_bigendian else "<u2"))
    if bits > 8:
        pixels = np.minimum(pixels >> (bits - 8), 255).astype(np.uint8)
    if channels == 4 and conversion is None:  # transparency comes first
        pixels = pixels[:, :, 1:] if encoding == "argb8" else pixels[:, :, :0:-1]
    if conversion is None:
        # Kernels are compiled for writeable arrays, which all other conversions return.
        return np.array(pixels)
    if channels == 2 and pixels.shape[1] % 2:  # two pixels share their colours; not every OpenCV minds
        raise _not_whole(message)
    try:
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), conversion), np.uint8)
    except cv2.error as error:  # Bayer patterns need two rows
        raise _not_whole(message) from error


def _decode_planar(message: Any, colour_bytes: float, conversion: int) -> U8:
    """Return the RGB image of YUV whose planes of colour follow that of brightness; colours are thinned to 4:2:0."""
    data, width, height, step = message_bytes(message.data), int(message.width), int(message.height), int(message.step)
    if height * width > MAX_PIXELS:
        raise InputError(f"an image of {width}x{height} is larger than {MAX_PIXELS // 1_000_000} million pixels")
    share = 1 + colour_bytes
    if len(data) == int(width * height * share):
        step = width  # some drivers count the colours in
    elif height % 3 == 0 and colour_bytes == 0.5 and step * height <= len(data) < int(step * height * share):
        height = height * 2 // 3  # others count the rows of colours
    if height < 2 or width < 2 or height % 2 or width % 2 or step < width or len(data) < int(step * height * share):
        raise _not_whole(message)
    bright, colours = data[: step * height], data[step * height : int(step * height * share)]
    if conversion in (cv2.COLOR_YUV2RGB_I420, cv2.COLOR_YUV2RGB_YV12):
        colours = colours.reshape(height, step // 2)[:, : width // 2].reshape(height // 2, width)
    elif colour_bytes == 2:
        colours = colours.reshape(height, step, 2)[::2, :width:2].reshape(height // 2, width)
    else:
        colours = colours.reshape(-1, step)[:: int(2 * colour_bytes), :width]
    planes = np.vstack([bright.reshape(height, step)[:, :width], colours])
    return np.asarray(cv2.cvtColor(planes, conversion), np.uint8)


def _not_whole(message: Any) -> InputError:
    size = f"{message.width}x{message.height}"
    return InputError(
        f"an image of {size} is not a whole {message.encoding} image: step {message.step}, {len(message.data)} bytes"
    )


def _decode_compressed(message: Any) -> U8:
    if is_compressed_depth(message.format):
        raise InputError(f"the compressed image format {message.format!r} is a depth image, not a picture")
    if find_video_codec(message.format):
        raise InputError(
            f"the compressed image format {message.format!r} is video, whose images need those before them: in bags it "
            "is decoded from the first key frame on if PyAV is there (`pip install av`), nodes need JPEG or raw images"
        )
    return _decode_file(message_bytes(message.data), message.format)


def find_video_codec(form: str) -> str:
    """Return FFmpeg's name of the codec of a `format` that is video, or of any text with such a name; else empty."""
    words = form.lower()
    return next((codec for codec, names in _VIDEO.items() if names.search(words)), "")


def _decode_file(data: U8, form: str) -> U8:
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(data, flags) if len(data) else None
    except cv2.error:  # the header names more pixels than OpenCV accepts
        image = None
    if image is None:
        raise InputError(f"a compressed image of format {form!r} and {len(data)} bytes cannot be decoded")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def _read_rows(message: Any, channels: int, dtype: np.dtype[Any]) -> Array:
    """Return the pixels (H, W) or (H, W, channels) of a raw Image without the padding of its rows."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    if height * width > MAX_PIXELS:
        raise InputError(f"an image of {width}x{height} is larger than {MAX_PIXELS // 1_000_000} million pixels")
    data = message_bytes(message.data)
    needed = width * channels * dtype.itemsize
    step = step or needed  # some drivers leave it out
    if height < 1 or width < 1 or step < needed or len(data) < step * (height - 1) + needed:
        raise InputError(f"an image of {width}x{height} {message.encoding} has step {step} and {len(data)} bytes")
    rows = np.lib.stride_tricks.as_strided(data, (height, needed), (step, 1), writeable=False)
    pixels = np.ascontiguousarray(rows).view(dtype)
    return pixels if channels == 1 else pixels.reshape(height, width, channels)


def decode_labels(message: Any) -> U8:
    """Return the labels (H, W) of a mono8 Image; InputError for another encoding."""
    if message.encoding.lower() not in ("mono8", "8uc1"):
        raise InputError(f"part labels must be mono8, not {message.encoding!r}")
    return np.asarray(_read_rows(message, 1, np.dtype("u1")))


def decode_flow(message: Any) -> F32:
    """Return the flow (H, W, 2) of a 32FC2 Image: pixels, +x right, +y down, NaN where unknown or absurd."""
    if message.encoding.upper() != "32FC2":
        raise InputError(f"optical flow must be 32FC2, not {message.encoding!r}")
    pixels = _read_rows(message, 2, np.dtype(">f4" if message.is_bigendian else "<f4"))
    pixels = pixels.astype(np.float32, copy=False)
    valid = np.abs(pixels) < MAX_FLOW_PX
    return pixels if valid.all() else np.where(valid.all(axis=2, keepdims=True), pixels, np.float32(np.nan))


def is_depth_encoding(encoding: str) -> bool:
    """Return whether `decode_depth` reads images of this encoding; mono16 may be a picture as well."""
    return encoding.lower() in _DEPTH


def decode_depth(message: Any) -> F32:
    """Return the depth (H, W) of a depth Image in metres along the optical axis (REP-118), NaN where unknown.

    16UC1 is in millimetres and 0 is unknown; 32FC1 is in metres, and values that are not positive or not finite are
    unknown. A CompressedImage of the transport `compressedDepth` is decoded too.
    """
    if hasattr(message, "format"):
        raw: Array = decode_compressed_depth(message)
        unit = 0.001 if raw.dtype == np.uint16 else 1.0
    else:
        encoding = message.encoding.lower()
        if encoding not in _DEPTH:
            raise InputError(f"depth must be 16UC1 (mm) or 32FC1 (m), not {message.encoding!r}")
        form, unit = _DEPTH[encoding]
        raw = _read_rows(message, 1, np.dtype((">" if message.is_bigendian else "<") + form))
    depth = raw.astype(np.float32) * np.float32(unit)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(np.nan))


def make_image(factory: MessageFactory, header: Any, pixels: Array, encoding: str) -> Any:
    """Return the Image of `pixels` (H, W) or (H, W, C), whose type fits `encoding`."""
    little = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("<"))
    return factory.make(
        "sensor_msgs/msg/Image",
        header=header,
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=little.nbytes // pixels.shape[0],
        data=little.reshape(-1).view(np.uint8),
    )


def compress_image(factory: MessageFactory, message: Any) -> Any:
    """Return the CompressedImage (JPEG) of an rgb8 Image."""
    rgb = decode_image(message)
    return factory.make(
        "sensor_msgs/msg/CompressedImage",
        header=message.header,
        format="rgb8; jpeg compressed bgr8",
        data=encode_jpeg(rgb),
    )


def encode_jpeg(rgb: U8, quality: int = JPEG_QUALITY) -> U8:
    """Return the JPEG file of an RGB image (H, W, 3) as bytes (N,)."""
    done, data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise InputError(f"an image of shape {rgb.shape} cannot be written as JPEG")
    return np.asarray(data, np.uint8).reshape(-1)
