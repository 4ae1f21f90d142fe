# SPDX-License-Identifier: Apache-2.0
"""Read the frames of a video file or a folder of images, one after the other."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from flowing_puppet_ros.arrays import U8
from flowing_puppet_ros.errors import InputError

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm"})
FOLDER_FPS = 30.0  # assumed for images in a folder, which carry no rate
MAX_BROKEN_FRAMES = 100  # consecutive frames that cannot be decoded before a video is given up


@dataclass(frozen=True, slots=True, eq=False)
class VideoFrame:
    """One image (H, W, 3) RGB uint8, its index, its time since the start, and its file in a folder ("" in a video)."""

    index: int
    stamp_ns: int
    image: U8
    path: str


@dataclass(frozen=True, slots=True)
class FrameSource:
    """Frames of a video or folder: iterate to read them. `count` is what the container claims, 0 when unknown.

    `warn` is called for frames that cannot be read and are skipped; without it the first such image is an error.
    """

    path: Path
    fps: float
    count: int
    files: tuple[Path, ...]
    warn: Callable[[str], None] | None = None

    def __iter__(self) -> Iterator[VideoFrame]:
        """Yield the frames in order; InputError when there are none, or at the first that cannot be read."""
        images = self._read_images() if self.files else self._read_video()
        index = -1
        for index, image, path in images:
            rgb = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
            yield VideoFrame(index, round(index * 1e9 / self.fps), rgb, path)
        if index < 0:
            raise InputError(f"{self.path} has no frame that can be decoded; it is broken or its codec is unknown")

    def read_size(self, index: int) -> tuple[int, int] | None:
        """Return width and height of an image of the folder or of a video's frames, px; None if it cannot be read."""
        if not self.files:
            return next(((frame.image.shape[1], frame.image.shape[0]) for frame in self), None)
        image = cv2.imread(str(self.files[index]), cv2.IMREAD_COLOR) if index < len(self.files) else None
        return None if image is None else (image.shape[1], image.shape[0])

    def _read_images(self) -> Iterator[tuple[int, U8, str]]:
        for index, path in enumerate(self.files):
            image = cv2.imread(str(path), cv2.IMREAD_COLOR)
            if image is not None:
                yield index, np.asarray(image, dtype=np.uint8), str(path)
            elif self.warn is None:
                raise InputError(f"{path} is not a readable image; remove or replace it")
            else:
                self.warn(f"frame {index}: {path} is not a readable image and is skipped")

    def _read_video(self) -> Iterator[tuple[int, U8, str]]:
        capture = cv2.VideoCapture(str(self.path))
        index, broken = 0, 0
        try:
            # Containers often announce more frames than they have, so frames missing at the end mean nothing.
            while broken <= MAX_BROKEN_FRAMES:
                read, image = capture.read()
                if read:
                    if broken and self.warn is not None:
                        self.warn(f"{broken} frames from {index - broken} on cannot be decoded and are skipped")
                    broken = 0
                    yield index, np.asarray(image, dtype=np.uint8), ""
                elif index >= self.count:
                    break
                else:
                    broken += 1
                index += 1
        finally:
            capture.release()


def open_frames(path: str | Path, warn: Callable[[str], None] | None = None) -> FrameSource:
    """Open a video file or a folder of images, in natural order (frame2 before frame10); InputError with the reason.

    `warn` as in `FrameSource`.
    """
    path = Path(path)
    if path.is_dir():
        files = tuple(sorted((f for f in path.iterdir() if f.suffix.lower() in IMAGE_SUFFIXES), key=natural_sort_key))
        if not files:
            raise InputError(f"the folder {path} has no images ({' '.join(sorted(IMAGE_SUFFIXES))})")
        return FrameSource(path, FOLDER_FPS, len(files), files, warn)
    if not path.is_file():
        raise InputError(f"{path} does not exist; give a video file, a folder of images or a bag")
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return FrameSource(path, FOLDER_FPS, 1, (path,))
    capture = cv2.VideoCapture(str(path))
    opened, fps, count = capture.isOpened(), capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
    capture.release()
    if not opened:
        raise InputError(f"{path} is not a readable video; give a video file, a folder of images or a bag")
    rate = fps if np.isfinite(fps) and 0 < fps <= 1e4 else FOLDER_FPS
    return FrameSource(path, float(rate), max(0, int(count)), (), warn)


def natural_sort_key(path: Path) -> tuple[list[tuple[int, int, str]], str]:
    """Return a sorting key that compares the runs of digits in a name as numbers."""
    pieces = re.findall(r"(\d+)|(\D+)", path.name)
    return [(0, int(digits), "") if digits else (1, 0, text) for digits, text in pieces], path.name
