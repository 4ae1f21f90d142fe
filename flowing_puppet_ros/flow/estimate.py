# SPDX-License-Identifier: Apache-2.0
"""Dense optical flow between two images, forward and backward.

Flow is a (H, W, 2) float32 array of displacements (x right, y down) in pixels of its own grid; NaN is unknown.
The estimator is DIS (Kroeger et al., "Fast Optical Flow using Dense Inverse Search", ECCV 2016) as OpenCV has it.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from flowing_puppet_ros.arrays import U8, Flow
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.settings import Settings, setting

type FlowPair = tuple[Flow, Flow]

PRESETS = {
    "ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
    "fast": cv2.DISOPTICAL_FLOW_PRESET_FAST,
    "medium": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
}
SMALLEST_SIDE = 16


@dataclass(frozen=True)
class FlowSettings(Settings):
    """How the dense flow is computed."""

    preset: str = setting("medium", "DIS preset: medium is more accurate, fast is for live use", choices=(*PRESETS,))
    max_side: int = setting(640, "longest image side the flow is computed at", unit="px", low=32, high=8192)


def as_image(image: U8) -> U8:
    """Return the (H, W) or (H, W, 3) uint8 array that `image` is; InputError when it is no such image."""
    image = np.asarray(image)
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
        raise InputError(f"an image must be uint8 and grey or RGB, this one is {image.dtype} of shape {image.shape}")
    if min(image.shape[:2]) < SMALLEST_SIDE:
        raise InputError(f"an image must be at least {SMALLEST_SIDE} px on each side, this one is {image.shape[:2]}")
    return image


def working_size(shape: tuple[int, ...], max_side: int) -> tuple[int, int]:
    """Width and height that an image of `shape` (H, W, ...) is reduced to, so that neither exceeds `max_side`."""
    height, width = shape[:2]
    factor = min(1.0, max_side / max(height, width))
    return max(SMALLEST_SIDE, round(width * factor)), max(SMALLEST_SIDE, round(height * factor))


def resize_flow(flow: Flow, size: tuple[int, int]) -> Flow:
    """Resample a flow field to `size` (width, height), displacements in pixels of the new grid; NaN stays NaN."""
    height, width = flow.shape[:2]
    if (width, height) == size:
        return np.ascontiguousarray(flow, dtype=np.float32)
    shrinks = size[0] < width
    resized = cv2.resize(flow, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    resized *= np.array([size[0] / width, size[1] / height], dtype=np.float32)
    return np.asarray(resized, dtype=np.float32)


class OpticalFlow:
    """Forward and backward DIS flow of an image pair; the same bits on any number of threads."""

    def __init__(self, settings: FlowSettings | None = None) -> None:
        self.settings = settings or FlowSettings()
        preset = PRESETS[self.settings.preset]
        self._estimators = tuple(cv2.DISOpticalFlow.create(preset) for _ in range(2))
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="backward-flow")

    def prepare(self, image: U8) -> U8:
        """Return `image` (RGB or grey) as the grey working image (h, w) that `between` takes."""
        image = as_image(image)
        size = working_size(image.shape, self.settings.max_side)
        if (image.shape[1], image.shape[0]) != size:
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        if image.ndim == 3:
            image = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        return np.ascontiguousarray(image)

    def between(self, previous: U8, current: U8) -> FlowPair:
        """Flow (forward, backward) of two prepared grey images, in pixels of the working grid."""
        if previous.shape != current.shape:
            raise InputError(f"flow needs images of one size, these are {previous.shape} and {current.shape}")
        # DIS splits its work by OpenCV's thread count and the split shows in the result.
        cv2.setNumThreads(1)
        backward = self._pool.submit(self._estimate, 1, current, previous)
        return self._estimate(0, previous, current), backward.result()

    def _estimate(self, which: int, source: U8, target: U8) -> Flow:
        flow = np.zeros((*source.shape, 2), np.float32)  # overwritten: no start is taken from it
        return np.asarray(self._estimators[which].calc(source, target, flow), dtype=np.float32)

    def at_working_scale(self, previous: U8, current: U8) -> FlowPair:
        """Flow (forward, backward) of two images, on the working grid and in its pixels."""
        return self.between(self.prepare(previous), self.prepare(current))

    def __call__(self, previous: U8, current: U8) -> FlowPair:
        """Flow (forward, backward), each (H, W, 2) float32, on the grid and in the pixels of the two images."""
        if previous.shape[:2] != current.shape[:2]:
            raise InputError(f"flow needs images of one size, these are {previous.shape[:2]} and {current.shape[:2]}")
        forward, backward = self.at_working_scale(previous, current)
        size = (previous.shape[1], previous.shape[0])
        return resize_flow(forward, size), resize_flow(backward, size)
