# SPDX-License-Identifier: Apache-2.0
"""What a still camera sees behind its people: a mean and a variance per pixel, learned only where nobody stands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F32, Bools, Image
from flowing_puppet_ros.settings import Settings, setting

# A pixel that differs by this many spreads and grey levels counts as changed; more than this share changed: new scene.
_CHANGED_SPREADS = 6.0
_CHANGED_LEVELS = 25.0
_NEW_SCENE_SHARE = 0.5
_NEW_SCENE_FRAMES = 3
# A value farther than this many grey levels and spreads from the mean is learned as if it were that far.
_LIKELY_LEVELS = 8.0
_LIKELY_SPREADS = 3.0
# A shadow leaves at least this share of the light, and its share differs between channels by no more than this.
_DARKEST_SHADOW = 0.35
_SHADOW_TINT = 0.12


@dataclass(frozen=True)
class BackgroundSettings(Settings):
    """How the background of one camera is learned."""

    min_frames: int = setting(3, "frames a pixel must have been seen bare to be known", unit="frames", low=2, high=1000)
    memory: int = setting(200, "frames after which old appearance fades", unit="frames", low=2, high=100000)


class Background:
    """Running mean and variance of every pixel over the frames in which it lay outside the people (causal).

    A person who never leaves a pixel keeps it unknown, so somebody who walks on the spot does not become background,
    as happens with a plain median. A frame in which more than half of the bare pixels differ from what is known is not
    learned; with the third such frame on end (the camera moved, the light changed) everything older is forgotten.
    """

    def __init__(self, settings: BackgroundSettings | None = None) -> None:
        """Know nothing yet; the image size is taken from the first update."""
        self.settings = settings or BackgroundSettings()
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._start((0, 0))

    def resize(self, shape: tuple[int, int]) -> None:
        """Start afresh when the images have had another `shape` (h, w) so far."""
        if self.count.shape != shape:
            self._start(shape)

    def _start(self, shape: tuple[int, int]) -> None:
        self.count = np.zeros(shape, np.int32)
        self.mean = np.zeros((*shape, 3), np.float32)
        self.variance = np.zeros((*shape, 3), np.float32)
        self._changed_frames = 0

    def update(self, image: Image, bare: Bools) -> None:
        """Learn from `image` (h,w,3) uint8 where `bare` (h,w) is true; another image size starts afresh."""
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
        """Pixels (h,w) that were seen bare often enough."""
        return self.count >= self.settings.min_frames

    def difference(self, image: Image) -> tuple[F32, F32]:
        """Largest channel difference (h,w) in grey levels, and the spread (h,w) of the background in that channel."""
        return _difference(self.mean, self.variance, np.ascontiguousarray(image))

    def shadow(self, image: Image) -> Bools:
        """Pixels (h,w) that are darker than the background by much the same factor in all channels."""
        return _shadow(self.mean, np.ascontiguousarray(image))

    def _same_scene(self, image: Image, bare: Bools) -> bool:
        judged = bare & self.known
        if not judged.any():
            return True
        levels, spread = self.difference(image)
        changed = (levels > _CHANGED_LEVELS) & (levels > _CHANGED_SPREADS * (spread + 1))
        return bool(np.count_nonzero(changed & judged) <= _NEW_SCENE_SHARE * np.count_nonzero(judged))


@njit(cache=True, nogil=True)
def _update(count, mean, variance, image, bare, min_frames, memory):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Welford's update with the count held at `memory`, which turns the mean into an exponential one.

    Once a pixel is known, a value pulls at most as far as a likely one: a limb the puppet misses leaves little trace.
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
                    likely = _LIKELY_LEVELS + _LIKELY_SPREADS * np.sqrt(variance[y, x, c])
                    delta = min(max(delta, -likely), likely)
                mean[y, x, c] += delta / n
                variance[y, x, c] += (delta * delta * (n - 1) / n - variance[y, x, c]) / n


@njit(cache=True, nogil=True)
def _difference(mean, variance, image):  # type: ignore[no-untyped-def]  # pragma: no cover
    height, width, channels = image.shape
    levels = np.zeros((height, width), np.float32)
    spread = np.zeros((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            for c in range(channels):
                delta = abs(image[y, x, c] - mean[y, x, c])
                if c == 0 or delta > levels[y, x]:
                    levels[y, x] = delta
                    spread[y, x] = np.sqrt(variance[y, x, c])
    return levels, spread


@njit(cache=True, nogil=True)
def _shadow(mean, image):  # type: ignore[no-untyped-def]  # pragma: no cover
    height, width, channels = image.shape
    shadow = np.zeros((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            darkest, brightest = np.inf, 0.0
            for c in range(channels):
                factor = (image[y, x, c] + 1.0) / (mean[y, x, c] + 1.0)
                darkest, brightest = min(darkest, factor), max(brightest, factor)
            shadow[y, x] = brightest < 1 and darkest > _DARKEST_SHADOW and brightest - darkest < _SHADOW_TINT
    return shadow
