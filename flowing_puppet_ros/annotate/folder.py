# SPDX-License-Identifier: Apache-2.0
"""The images and video frames of the folder that is annotated, each named by a key; nothing outside it is read."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from flowing_puppet_ros.arrays import U8, Image
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.video_reader import IMAGE_SUFFIXES, natural_order

VIDEO_SUFFIXES = frozenset({".avi", ".mp4", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg"})
MOST_ITEMS = 200_000
MOST_BYTES = 500_000_000
MOST_PIXELS = 200_000_000
SHOWN_PIXELS = 16_000_000  # larger images reach the browser reduced
KEPT_IMAGES = 4


@dataclass(eq=False)
class ImageFolder:
    """Images (key "sub/name.jpg") and frames of videos (key "sub/name.avi#12") below `root`, in natural order.

    Files that lead out of the folder (symbolic links) are not items. Thread-safe.
    """

    root: Path
    items: tuple[str, ...] = field(init=False)
    _place: dict[str, int] = field(init=False, repr=False)
    _kept: OrderedDict[str, Image] = field(init=False, repr=False, default_factory=OrderedDict)
    _lock: threading.Lock = field(init=False, repr=False, default_factory=threading.Lock)
    _video: _OpenVideo = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """List the items; InputError when the folder is none or has nothing to annotate."""
        self._video = _OpenVideo()
        self.root = self.root.resolve()
        if not self.root.is_dir():
            raise InputError(f"{self.root} is no folder; give a folder of images or videos")
        keys: list[str] = []
        for path in sorted(self.root.rglob("*"), key=natural_order):
            if not self._is_inside(path):
                continue
            name = path.relative_to(self.root).as_posix()
            if path.suffix.lower() in IMAGE_SUFFIXES:
                keys.append(name)
            elif path.suffix.lower() in VIDEO_SUFFIXES:
                keys += [f"{name}#{frame}" for frame in range(_frame_count(path))]
            if len(keys) > MOST_ITEMS:
                raise InputError(f"{self.root} has more than {MOST_ITEMS} images and frames; annotate a part of it")
        if not keys:
            raise InputError(f"{self.root} has no image or video that can be annotated")
        self.items = tuple(keys)
        self._place = {key: place for place, key in enumerate(keys)}

    def __contains__(self, key: object) -> bool:
        """Whether `key` names an item."""
        return key in self._place

    def before(self, key: str) -> str | None:
        """The item of the same folder or video just before `key`; None when it is the first there."""
        place = self._place[key]
        if place == 0:
            return None
        other = self.items[place - 1]
        return other if _series(other) == _series(key) else None

    def image(self, key: str) -> Image:
        """The image (H, W, 3) RGB of an item; InputError with the reason when it cannot be shown."""
        if key not in self._place:
            raise InputError(f"{key!r} is no image of this folder")
        with self._lock:
            if key not in self._kept:
                self._kept[key] = self._read(key)
            self._kept.move_to_end(key)
            while len(self._kept) > KEPT_IMAGES:
                self._kept.popitem(last=False)
            return self._kept[key]

    def picture(self, key: str) -> bytes:
        """The item as a JPEG file for the browser, at most SHOWN_PIXELS large."""
        image = self.image(key)
        factor = (SHOWN_PIXELS / (image.shape[0] * image.shape[1])) ** 0.5
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
        # Files may have been exchanged since the start.
        if not self._is_inside(path):
            raise InputError(f"{key} has left the folder; start the annotation tool again")
        if frame is None and path.stat().st_size > MOST_BYTES:
            raise InputError(f"{key} has {path.stat().st_size} bytes, too many to show")
        image = cv2.imread(str(path), cv2.IMREAD_COLOR) if frame is None else self._video.read(path, frame)
        if image is None:
            raise InputError(f"{key} cannot be decoded; remove or replace it")
        if image.shape[0] * image.shape[1] > MOST_PIXELS:
            raise InputError(f"{key} has {image.shape[1]} x {image.shape[0]} pixels, too many to show")
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def split_key(key: str) -> tuple[str, int | None]:
    """File name and frame of a key; the frame is None for an image."""
    name, mark, frame = key.rpartition("#")
    return (name, int(frame)) if mark and frame.isdigit() else (key, None)


def _series(key: str) -> str:
    """What an item follows others in: its video, or its folder."""
    name, frame = split_key(key)
    return name.rpartition("/")[0] + "/" if frame is None else name


def _frame_count(path: Path) -> int:
    capture = cv2.VideoCapture(str(path))
    try:
        return max(0, min(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), MOST_ITEMS + 1)) if capture.isOpened() else 0
    finally:
        capture.release()


class _OpenVideo:
    """The video that was read last, open where it was left; frames are counted, not sought.

    The positions that containers claim are often wrong.
    """

    def __init__(self) -> None:
        self._path: Path | None = None
        self._next = 0
        self._capture = cv2.VideoCapture()

    def read(self, path: Path, index: int) -> U8 | None:
        """Frame `index` (H, W, 3) BGR; None when the video has no such frame."""
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
