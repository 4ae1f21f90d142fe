# SPDX-License-Identifier: Apache-2.0
"""Images and video frames of the folder to annotate, each named by a key; nothing outside the folder is read."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from flowing_puppet_ros.arrays import U8, Image
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.video_reader import IMAGE_SUFFIXES, natural_sort_key

VIDEO_SUFFIXES = frozenset({".avi", ".mp4", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg"})
MAX_ITEMS = 200_000  # images and frames of a folder
MAX_FILE_BYTES = 500_000_000  # of an image file
MAX_PIXELS = 200_000_000  # of an image
MAX_SHOWN_PIXELS = 16_000_000  # larger images reach the browser reduced
MAX_CACHED_IMAGES = 4  # decoded images kept in memory


@dataclass(eq=False)
class ImageFolder:
    """Images (key "sub/name.jpg") and frames of videos (key "sub/name.avi#12") below `root`, in natural order.

    Files that lead out of the folder (symbolic links) are not items. Thread-safe.
    """

    root: Path
    items: tuple[str, ...] = field(init=False)
    _index: dict[str, int] = field(init=False, repr=False)
    _cache: OrderedDict[str, Image] = field(init=False, repr=False, default_factory=OrderedDict)
    _lock: threading.Lock = field(init=False, repr=False, default_factory=threading.Lock)
    _video: _OpenVideo = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """List the items; InputError when `root` is not a folder or has nothing to annotate."""
        self._video = _OpenVideo()
        self.root = self.root.resolve()
        if not self.root.is_dir():
            raise InputError(f"{self.root} is not a folder; give a folder of images or videos")
        keys: list[str] = []
        for path in sorted(self.root.rglob("*"), key=natural_sort_key):
            if not self._is_inside(path):
                continue
            name = path.relative_to(self.root).as_posix()
            if path.suffix.lower() in IMAGE_SUFFIXES:
                keys.append(name)
            elif path.suffix.lower() in VIDEO_SUFFIXES:
                keys += [f"{name}#{frame}" for frame in range(_count_frames(path))]
            if len(keys) > MAX_ITEMS:
                raise InputError(f"{self.root} has more than {MAX_ITEMS} images and frames; annotate a part of it")
        if not keys:
            raise InputError(f"{self.root} has no image or video that can be annotated")
        self.items = tuple(keys)
        self._index = {key: place for place, key in enumerate(keys)}

    def __contains__(self, key: object) -> bool:
        """Return whether `key` names an item."""
        return key in self._index

    def previous(self, key: str) -> str | None:
        """Return the item just before `key` in the same folder or video; None for the first one."""
        place = self._index[key]
        if place == 0:
            return None
        other = self.items[place - 1]
        return other if _series_name(other) == _series_name(key) else None

    def load_image(self, key: str) -> Image:
        """Return the image (H, W, 3) RGB of an item; InputError with the reason when it cannot be shown."""
        if key not in self._index:
            raise InputError(f"{key!r} is not an image of this folder")
        with self._lock:
            if key not in self._cache:
                self._cache[key] = self._read(key)
            self._cache.move_to_end(key)
            while len(self._cache) > MAX_CACHED_IMAGES:
                self._cache.popitem(last=False)
            return self._cache[key]

    def encode_jpeg(self, key: str) -> bytes:
        """Encode an item as a JPEG file for the browser, reduced to MAX_SHOWN_PIXELS if larger."""
        image = self.load_image(key)
        factor = (MAX_SHOWN_PIXELS / (image.shape[0] * image.shape[1])) ** 0.5
        if factor < 1:
            size = max(1, int(image.shape[1] * factor)), max(1, int(image.shape[0] * factor))
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        done, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 92])
        if not done:
            raise InputError(f"{key} cannot be shown: it does not encode as JPEG")
        return bytes(data)

    def _is_inside(self, path: Path) -> bool:
        return path.is_file() and path.resolve().is_relative_to(self.root)

    def _read(self, key: str) -> Image:
        name, frame = split_key(key)
        path = self.root / name
        # Files may have been replaced since the start.
        if not self._is_inside(path):
            raise InputError(f"{key} is no longer in the folder; restart the annotation tool")
        if frame is None and path.stat().st_size > MAX_FILE_BYTES:
            raise InputError(f"{key} has {path.stat().st_size} bytes, too many to show")
        image = cv2.imread(str(path), cv2.IMREAD_COLOR) if frame is None else self._video.read(path, frame)
        if image is None:
            raise InputError(f"{key} cannot be decoded; remove or replace it")
        if image.shape[0] * image.shape[1] > MAX_PIXELS:
            raise InputError(f"{key} has {image.shape[1]} x {image.shape[0]} pixels, too many to show")
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def split_key(key: str) -> tuple[str, int | None]:
    """Split a key into file name and frame; the frame is None for an image."""
    name, mark, frame = key.rpartition("#")
    return (name, int(frame)) if mark and frame.isdigit() else (key, None)


def _series_name(key: str) -> str:
    """Return the name of the series that an item belongs to: its video, or its folder."""
    name, frame = split_key(key)
    return name.rpartition("/")[0] + "/" if frame is None else name


def _count_frames(path: Path) -> int:
    capture = cv2.VideoCapture(str(path))
    try:
        return max(0, min(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), MAX_ITEMS + 1)) if capture.isOpened() else 0
    finally:
        capture.release()


class _OpenVideo:
    """The video that was read last, kept open at its position; frames are counted, not sought.

    The positions that containers claim are often wrong.
    """

    def __init__(self) -> None:
        self._path: Path | None = None
        self._next = 0
        self._capture = cv2.VideoCapture()

    def read(self, path: Path, index: int) -> U8 | None:
        """Return frame `index` (H, W, 3) BGR; None when the video has no such frame."""
        if path != self._path or index < self._next:
            self._capture.open(str(path))
            self._path, self._next = path, 0
        while self._next < index and self._capture.grab():
            self._next += 1
        read, image = self._capture.read()
        if self._next != index or not read:
            self._path = None
            return None
        self._next += 1
        return np.asarray(image, dtype=np.uint8)
