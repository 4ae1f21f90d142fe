# SPDX-License-Identifier: Apache-2.0
"""Tracks as a video as in the thesis's Figure 10: each frame beside its forward flow, with puppets over both."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from flowing_puppet_ros.arrays import Image
from flowing_puppet_ros.draw.flow_colour import flow_scale, flow_to_rgb
from flowing_puppet_ros.draw.overlay import FIXED_BITS, DrawnPuppet, draw_puppets, is_drawable, to_fixed_point
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.flow.estimate import MIN_SIDE_PX, OpticalFlow, resize_flow

CODECS = {".mp4": "mp4v", ".m4v": "mp4v", ".avi": "MJPG", ".mkv": "MJPG"}
MAX_SIDE_PX = 960  # of a frame in the video, where two are side by side
SCALE_SMOOTHING = 0.1  # weight of a new frame in the motion at full colour, so that the colours do not flicker


def check_overlay(path: Path) -> None:
    """Check that a video of this name can be written; InputError otherwise."""
    if path.suffix.lower() not in CODECS:
        raise InputError(f"--overlay {path} must end in {', '.join(CODECS)}")


def read_drawn_tracks(path: Path) -> Iterator[tuple[int, list[DrawnPuppet]]]:
    """Yield (index, puppets) of each frame in a tracks.json of `tracks_json.write_tracks`, one line per frame."""
    with path.open(encoding="utf-8") as file:
        names = tuple(json.loads(file.readline().rstrip() + "]}")["joint_names"])
        for line in file:
            if line.startswith("{"):
                frame = json.loads(line.rstrip().rstrip(","))
                yield frame["index"], [_make_drawn_puppet(names, puppet) for puppet in frame["puppets"]]


def _make_drawn_puppet(names: tuple[str, ...], puppet: dict[str, Any]) -> DrawnPuppet:
    rows = np.array(puppet["joints"], np.float64)
    parts = puppet["parts"]
    order = tuple(sorted(range(len(parts)), key=lambda k: parts[k]["depth"]))
    contours = tuple(np.array(part["contour"], np.float64) for part in parts)
    return DrawnPuppet(
        puppet["id"], names, rows[:, :2], rows[:, 2], tuple(part["name"] for part in parts), contours, order
    )


def write_overlay(
    path: Path, images: Iterable[tuple[int, Image]], tracks: Iterable[tuple[int, list[DrawnPuppet]]], fps: float
) -> int:
    """Write the video and return its number of frames.

    `images` are (index, (H, W, 3) RGB) and `tracks` (index, puppets), both in order; an image without an entry is
    shown without puppets. The flow of the last frame, and of a frame before a change of size, is unknown: black.
    InputError if the video cannot be written.
    """
    check_overlay(path)
    flow, full, writer = OpticalFlow(), 0.0, _VideoFile(path, fps)
    shown: tuple[Image, list[DrawnPuppet]] | None = None
    try:
        for image, puppets in _join_tracks(images, tracks):
            factor = min(1.0, MAX_SIDE_PX / max(image.shape[:2]))
            small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) if factor < 1 else image
            following = np.asarray(small, np.uint8), [puppet.transform(factor) for puppet in puppets]
            if shown is not None:
                field = _estimate_flow(flow, shown[0], following[0])
                if field is not None:
                    full = (
                        flow_scale(field)
                        if full == 0.0
                        else (1 - SCALE_SMOOTHING) * full + SCALE_SMOOTHING * flow_scale(field)
                    )
                writer.add(draw_beside_flow(*shown, field, full))
            shown = following
        if shown is not None:
            writer.add(draw_beside_flow(*shown, None, full))
    finally:
        writer.close()
    return writer.count


def _join_tracks(
    images: Iterable[tuple[int, Image]], tracks: Iterable[tuple[int, list[DrawnPuppet]]]
) -> Iterator[tuple[Image, list[DrawnPuppet]]]:
    entries = iter(tracks)
    entry = next(entries, None)
    for index, image in images:
        while entry is not None and entry[0] < index:
            entry = next(entries, None)
        yield image, entry[1] if entry is not None and entry[0] == index else []


def _estimate_flow(flow: OpticalFlow, image: Image, following: Image) -> np.ndarray | None:
    if image.shape != following.shape or min(image.shape[:2]) < MIN_SIDE_PX:
        return None
    return resize_flow(flow.estimate_at_working_scale(image, following)[0], (image.shape[1], image.shape[0]))


def draw_beside_flow(image: Image, puppets: Sequence[DrawnPuppet], flow: np.ndarray | None, full: float) -> Image:
    """Draw `image` (H, W, 3) with puppets, and beside it its flow (H, W, 2) in colour with their outlines in black."""
    left = draw_puppets(image, puppets, labels=False)
    right = np.zeros_like(left) if flow is None else flow_to_rgb(flow, full)
    width = max(1, round(min(image.shape[:2]) / 360))
    for puppet in puppets:
        for part in puppet.order:
            contour = puppet.contours[part]
            if is_drawable(contour):
                colour = (0, 0, 0) if flow is not None else (255, 255, 255)
                cv2.polylines(right, [to_fixed_point(contour)], True, colour, width, cv2.LINE_AA, FIXED_BITS)
    return np.concatenate([left, right], axis=1)


class _VideoFile:
    """A video file of the size of its first picture; other pictures are fitted into it."""

    def __init__(self, path: Path, fps: float) -> None:
        self.count = 0
        self._path, self._fps = path, fps
        self._size = (0, 0)
        self._video: cv2.VideoWriter | None = None

    def add(self, picture: Image) -> None:
        """Write one picture (H, W, 3) RGB."""
        if self._video is None:
            # Codecs need even sides.
            self._size = (picture.shape[1] // 2 * 2, picture.shape[0] // 2 * 2)
            self._path.parent.mkdir(parents=True, exist_ok=True)
            code = cv2.VideoWriter.fourcc(*CODECS[self._path.suffix.lower()])
            self._video = cv2.VideoWriter(str(self._path), code, self._fps, self._size)
            if not self._video.isOpened():
                raise InputError(f"--overlay {self._path} cannot be written; choose another folder")
        factor = min(self._size[0] / picture.shape[1], self._size[1] / picture.shape[0])
        canvas = np.zeros((self._size[1], self._size[0], 3), np.uint8)
        if picture.shape[1::-1] != self._size:
            size = [max(1, min(limit, round(side * factor)))
                    for side, limit in zip(picture.shape[1::-1], self._size, strict=True)]  # fmt: skip
            picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
        canvas[: picture.shape[0], : picture.shape[1]] = picture
        self._video.write(cv2.cvtColor(canvas, cv2.COLOR_RGB2BGR))
        self.count += 1

    def close(self) -> None:
        """Finish the file."""
        if self._video is not None:
            self._video.release()
