# SPDX-License-Identifier: Apache-2.0
"""The background of a still camera: a mean and a variance per pixel, learned only where there are no people."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F32, Bools, Image
from flowing_puppet_ros.settings import Settings, setting

# Standard deviations and grey levels by which a changed pixel differs from the background.
_MIN_CHANGE_DEVIATIONS = 6.0
_MIN_CHANGE_LEVELS = 25.0
# Share of changed pixels, and consecutive frames with so many, that make a new scene.
_NEW_SCENE_SHARE = 0.5
_NEW_SCENE_FRAMES = 3
# Grey levels plus standard deviations from the mean at which a value is clamped before it is learned.
_MAX_LEARNED_LEVELS = 8.0
_MAX_LEARNED_DEVIATIONS = 3.0
# Share of the light that a shadow leaves, and the maximum difference of that share between channels.
_MIN_SHADOW_SHARE = 0.35
_MAX_SHADOW_TINT = 0.12


@dataclass(frozen=True)
class BackgroundSettings(Settings):
    """How the background of one camera is learned."""

    min_frames: int = setting(
        3, "frames without people in which a pixel must be seen to be known", low=2, high=1000, advanced=True
    )
    memory: int = setting(200, "frames over which the background is averaged", low=2, high=100000, advanced=True)


class Background:
    """Running mean and variance of every pixel over the frames in which it lay outside the people (causal).

    A pixel that a person never leaves stays unknown, so a person who walks on the spot does not become background, as
    with a plain median. A frame in which more than half of the bare pixels differ from the background is not learned;
    after the third such frame in a row (the camera moved, the light changed) everything older is forgotten.
    """

    def __init__(self, settings: BackgroundSettings | None = None) -> None:
        """Start empty; the image size is taken from the first update."""
        self.settings = settings or BackgroundSettings()
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._start((0, 0))

    def resize(self, shape: tuple[int, int]) -> None:
        """Reset when the images so far had another `shape` (h, w)."""
        if self.count.shape != shape:
            self._start(shape)

    def _start(self, shape: tuple[int, int]) -> None:
        self.count = np.zeros(shape, np.int32)
        self.mean = np.zeros((*shape, 3), np.float32)
        self.variance = np.zeros((*shape, 3), np.float32)
        self._changed_frames = 0

    def update(self, image: Image, bare: Bools) -> None:
        """Learn from `image` (h, w, 3) uint8 where `bare` (h, w) is true; another image size resets."""
        self.resize((image.shape[0], image.shape[1]))
        if not self._same_scene(image, bare):
            self._changed_frames += 1
            if self._changed_frames < _NEW_SCENE_FRAMES:
                return
            self.count[:] = 0
        self._changed_frames = 0
        settings = self.settings
        _update(
            self.count,
            self.mean,
            self.variance,
            np.ascontiguousarray(image),
            bare,
            settings.min_frames,
            settings.memory,
        )

    @property
    def known(self) -> Bools:
        """Pixels (h, w) that were seen bare often enough."""
        return self.count >= self.settings.min_frames

    def difference(self, image: Image) -> tuple[F32, F32]:
        """Return the largest channel difference (h, w) in grey levels, and that channel's standard deviation (h, w)."""
        return _difference(self.mean, self.variance, np.ascontiguousarray(image))

    def find_shadows(self, image: Image) -> Bools:
        """Return the pixels (h, w) that are darker than the background by a similar factor in all channels."""
        return _find_shadows(self.mean, np.ascontiguousarray(image))

    def _same_scene(self, image: Image, bare: Bools) -> bool:
        compared = bare & self.known
        if not compared.any():
            return True
        levels, deviation = self.difference(image)
        changed = (levels > _MIN_CHANGE_LEVELS) & (levels > _MIN_CHANGE_DEVIATIONS * (deviation + 1))
        return bool(np.count_nonzero(changed & compared) <= _NEW_SCENE_SHARE * np.count_nonzero(compared))


@njit(cache=True, nogil=True)
def _update(count, mean, variance, image, bare, min_frames, memory):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Apply Welford's update with the count limited to `memory`, which turns the mean into an exponential one.

    Once a pixel is known, values are clamped to likely ones, so a limb that the puppet misses leaves little trace.
    """
    height, width, channels = image.shape
    for y in range(height):
        for x in range(width):
            if not bare[y, x]:
                continue
            n = min(count[y, x] + 1, memory)
            count[y, x] = n
            for c in range(channels):
                if n == 1:
                    mean[y, x, c] = image[y, x, c]
                    variance[y, x, c] = 0.0
                    continue
                delta = image[y, x, c] - mean[y, x, c]
                if n > min_frames:
                    limit = _MAX_LEARNED_LEVELS + _MAX_LEARNED_DEVIATIONS * np.sqrt(variance[y, x, c])
                    delta = min(max(delta, -limit), limit)
                mean[y, x, c] += delta / n
                variance[y, x, c] += (delta * delta * (n - 1) / n - variance[y, x, c]) / n


@njit(cache=True, nogil=True)
def _difference(mean, variance, image):  # type: ignore[no-untyped-def]  # pragma: no cover
    height, width, channels = image.shape
    levels = np.zeros((height, width), np.float32)
    deviation = np.zeros((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            for c in range(channels):
                delta = abs(image[y, x, c] - mean[y, x, c])
                if c == 0 or delta > levels[y, x]:
                    levels[y, x] = delta
                    deviation[y, x] = np.sqrt(variance[y, x, c])
    return levels, deviation


@njit(cache=True, nogil=True)
def _find_shadows(mean, image):  # type: ignore[no-untyped-def]  # pragma: no cover
    height, width, channels = image.shape
    shadow = np.zeros((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            darkest, brightest = np.inf, 0.0
            for c in range(channels):
                factor = (image[y, x, c] + 1.0) / (mean[y, x, c] + 1.0)
                darkest, brightest = min(darkest, factor), max(brightest, factor)
            shadow[y, x] = brightest < 1 and darkest > _MIN_SHADOW_SHARE and brightest - darkest < _MAX_SHADOW_TINT
    return shadow
