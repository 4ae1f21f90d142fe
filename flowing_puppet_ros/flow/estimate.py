# SPDX-License-Identifier: Apache-2.0
"""Dense optical flow between two images, forward and backward.

Flow is a (H, W, 2) float32 array of displacements (x right, y down) in pixels of its own grid; NaN is unknown.
The estimator is OpenCV's DIS (Kroeger et al., "Fast Optical Flow using Dense Inverse Search", ECCV 2016).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np

from flowing_puppet_ros.arrays import U8, Flow
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.flow.settings import FlowSettings
from flowing_puppet_ros.images import as_image, reduce_image
from flowing_puppet_ros.process.threads import one_opencv_thread

type FlowPair = tuple[Flow, Flow]

PRESETS = {
    "ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
    "fast": cv2.DISOPTICAL_FLOW_PRESET_FAST,
    "medium": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
}
MIN_SIDE_PX = 16  # of an image, as given and as reduced


def working_size(shape: tuple[int, ...], max_side: int) -> tuple[int, int]:
    """Return the width and height to which an image of `shape` (H, W, ...) is reduced: at most `max_side` px each."""
    height, width = shape[:2]
    factor = min(1.0, max_side / max(height, width))
    return max(MIN_SIDE_PX, round(width * factor)), max(MIN_SIDE_PX, round(height * factor))


def resize_flow(flow: Flow, size: tuple[int, int]) -> Flow:
    """Resample `flow` (H, W, 2) to `size` (width, height), in pixels of the new grid; NaN stays NaN."""
    height, width = flow.shape[:2]
    if (width, height) == size:
        return np.ascontiguousarray(flow, dtype=np.float32)
    is_smaller = size[0] < width
    resized = cv2.resize(flow, size, interpolation=cv2.INTER_AREA if is_smaller else cv2.INTER_LINEAR)
    resized *= np.array([size[0] / width, size[1] / height], dtype=np.float32)
    return np.asarray(resized, dtype=np.float32)


class OpticalFlow:
    """Forward and backward DIS flow of an image pair, bit for bit the same on any number of threads."""

    def __init__(self, settings: FlowSettings | None = None) -> None:
        self.settings = settings or FlowSettings()
        preset = PRESETS[self.settings.preset]
        self._estimators = tuple(cv2.DISOpticalFlow.create(preset) for _ in range(2))
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="backward-flow")

    def prepare(self, image: U8) -> U8:
        """Reduce an RGB or grey image to the grey working image (h, w) that `estimate_prepared` takes."""
        image = as_image(image, MIN_SIDE_PX)
        size = working_size(image.shape, self.settings.max_side)
        if (image.shape[1], image.shape[0]) != size:
            image = reduce_image(image, size)
        if image.ndim == 3:
            image = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        return np.ascontiguousarray(image)

    def estimate_prepared(self, previous: U8, current: U8) -> FlowPair:
        """Estimate the flow (forward, backward) of two prepared grey images, in pixels of the working grid."""
        if previous.shape != current.shape:
            raise InputError(f"flow needs images of one size, these are {previous.shape} and {current.shape}")
        # DIS splits its work by OpenCV's thread count, and the split changes the result.
        with one_opencv_thread():
            backward = self._pool.submit(self._run, 1, current, previous)
            return self._run(0, previous, current), backward.result()

    def _run(self, which: int, source: U8, target: U8) -> Flow:
        flow = np.zeros((*source.shape, 2), np.float32)  # overwritten, not an initial guess
        return np.asarray(self._estimators[which].calc(source, target, flow), dtype=np.float32)

    def estimate_at_working_scale(self, previous: U8, current: U8) -> FlowPair:
        """Estimate the flow (forward, backward) of two images, on the working grid and in its pixels."""
        return self.estimate_prepared(self.prepare(previous), self.prepare(current))

    def __call__(self, previous: U8, current: U8) -> FlowPair:
        """Estimate the flow (forward, backward), each (H, W, 2) float32, on the images' grid and in their pixels."""
        if previous.shape[:2] != current.shape[:2]:
            raise InputError(f"flow needs images of one size, these are {previous.shape[:2]} and {current.shape[:2]}")
        forward, backward = self.estimate_at_working_scale(previous, current)
        size = (previous.shape[1], previous.shape[0])
        return resize_flow(forward, size), resize_flow(backward, size)
