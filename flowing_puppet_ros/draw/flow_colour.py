# SPDX-License-Identifier: Apache-2.0
"""Colours of optical flow: hue is the direction, saturation the magnitude (Baker et al., IJCV 2011; thesis Fig. 2).

Still pixels are white, motion to the right is red, down yellow, left cyan to blue, up violet.
"""

from __future__ import annotations

import numpy as np
from numba import njit

# The wheel runs red, yellow, green, cyan, blue, magenta, red; the arcs are as long as Baker et al. make them, so that
# equal angles look about equally different.
_ARC_ENDS = np.array([0, 15, 21, 25, 36, 49, 55]) / 55
_ARC_COLOURS = np.array([(1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1), (1, 0, 1), (1, 0, 0)], float)
_WHEEL = np.stack([np.interp(np.arange(720) / 720, _ARC_ENDS, channel) for channel in _ARC_COLOURS.T], axis=1)


def flow_scale(flow: np.ndarray, percentile: float = 99.0) -> float:
    """Return the magnitude in pixels at full saturation: a percentile of `flow` (H, W, 2) where known, at least 1."""
    magnitude = np.hypot(flow[..., 0], flow[..., 1])
    known = magnitude[np.isfinite(magnitude)]
    return max(1.0, float(np.percentile(known, percentile))) if known.size else 1.0


def flow_to_rgb(flow: np.ndarray, scale: float | None = None) -> np.ndarray:
    """Colour `flow` (H, W, 2), pixels, +x right, +y down; return an RGB image (H, W, 3) uint8.

    `scale` is the magnitude in pixels of full saturation (default `flow_scale`); faster pixels are darker, unknown
    (NaN) ones black.
    """
    full = flow_scale(flow) if scale is None else scale
    return _colour(np.ascontiguousarray(flow, np.float32), np.float32(full), _WHEEL)


def draw_flow_legend(size: int = 96, background: int = 255) -> np.ndarray:
    """Draw the colour wheel, RGB (size, size, 3) uint8: the colour of the motion from the centre to each pixel."""
    axis = (np.arange(size, dtype=np.float32) - (size - 1) / 2) / (size / 2)
    flow = np.stack(np.meshgrid(axis, axis), axis=-1)
    legend = flow_to_rgb(flow, 1.0)
    legend[np.hypot(flow[..., 0], flow[..., 1]) > 1] = background
    return legend


@njit(cache=True, nogil=True)
def _colour(flow, scale, wheel):  # type: ignore[no-untyped-def]
    height, width = flow.shape[:2]
    rgb = np.zeros((height, width, 3), np.uint8)
    bins = len(wheel)
    for y in range(height):
        for x in range(width):
            u, v = flow[y, x, 0], flow[y, x, 1]
            if not (np.isfinite(u) and np.isfinite(v)):
                continue
            radius = np.sqrt(u * u + v * v) / scale
            place = int(np.arctan2(v, u) / (2 * np.pi) * bins + bins + 0.5) % bins
            for k in range(3):
                value = 1 - radius * (1 - wheel[place, k]) if radius <= 1 else 0.75 * wheel[place, k]
                rgb[y, x, k] = np.uint8(255 * value + 0.5)
    return rgb
