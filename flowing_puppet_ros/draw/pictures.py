# SPDX-License-Identifier: Apache-2.0
"""Helpers for finished pictures: scale, caption, join on a sheet, encode for a file or an HTML page."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from flowing_puppet_ros.errors import InputError


def scale_to_height(image: np.ndarray, height: int) -> np.ndarray:
    """Scale `image` (H, W, 3) to `height` rows and keep its aspect ratio."""
    factor = height / image.shape[0]
    size = (max(1, round(image.shape[1] * factor)), height)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR))


def shrink(image: np.ndarray, height: int) -> np.ndarray:
    """Scale `image` (H, W, 3) down to `height` rows; return a smaller image unchanged."""
    return image if image.shape[0] <= height else scale_to_height(image, height)


def add_caption(image: np.ndarray, text: str, size: float = 0.5) -> np.ndarray:
    """Write one line of ASCII text in the top left corner of a copy of the image, dark on a light bar."""
    image = image.copy()
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    image[: height + 10, : width + 12] = 245
    return cv2.putText(image, text, (6, height + 4), cv2.FONT_HERSHEY_SIMPLEX, size, (20, 20, 20), 1, cv2.LINE_AA)


def make_contact_sheet(images: Sequence[np.ndarray], columns: int, gap: int = 6, background: int = 255) -> np.ndarray:
    """Arrange `images` (H_k, W_k, 3) uint8 in rows of `columns`, each centred in a cell of the largest size."""
    if not images:
        raise ValueError("a contact sheet needs at least one image")
    height, width = (max(image.shape[axis] for image in images) for axis in (0, 1))
    rows = -(-len(images) // columns)
    columns = min(columns, len(images))
    shape = (rows * (height + gap) + gap, columns * (width + gap) + gap, 3)
    sheet = np.full(shape, background, np.uint8)
    for index, image in enumerate(images):
        row, column = divmod(index, columns)
        top = gap + row * (height + gap) + (height - image.shape[0]) // 2
        left = gap + column * (width + gap) + (width - image.shape[1]) // 2
        sheet[top : top + image.shape[0], left : left + image.shape[1]] = image
    return sheet


def join_row(images: Sequence[np.ndarray], height: int, gap: int = 6, background: int = 255) -> np.ndarray:
    """Join images side by side, all scaled to `height` rows."""
    bar = np.full((height, gap, 3), background, np.uint8)
    pieces = [piece for image in images for piece in (bar, scale_to_height(image, height))]
    return np.hstack(pieces[1:])


def encode(image: np.ndarray, kind: str = "jpg", quality: int = 82) -> bytes:
    """Encode an RGB image (H, W, 3) uint8 as the bytes of a "jpg" or "png" file."""
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if kind == "jpg" else [cv2.IMWRITE_PNG_COMPRESSION, 9]
    done, data = cv2.imencode("." + kind, np.ascontiguousarray(image[..., ::-1]), options)
    if not done:
        raise InputError(f"cannot encode a picture of shape {image.shape} as {kind}")
    return data.tobytes()


def encode_data_uri(image: np.ndarray, kind: str = "jpg", quality: int = 82) -> str:
    """Return an image as a `data:` URI, so that an HTML page needs no other file."""
    name = "jpeg" if kind == "jpg" else kind
    return f"data:image/{name};base64," + base64.b64encode(encode(image, kind, quality)).decode("ascii")


def save(image: np.ndarray, path: Path) -> None:
    """Write an RGB image (H, W, 3) uint8 as .png or .jpg, by the suffix of `path`."""
    kind = {".png": "png", ".jpg": "jpg", ".jpeg": "jpg"}.get(path.suffix.lower())
    if kind is None:
        raise InputError(f"{path} is not a picture name; end it in .png or .jpg")
    try:
        path.write_bytes(encode(image, kind, 90))
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}; choose another path") from error
