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
def _find_turn(u, v):  # type: ignore[no-untyped-def]
    """Return the direction of (u, v) in turns, 0 to 1, to a 50,000th: a polynomial is four times as fast as arctan2."""
    low, high = min(abs(u), abs(v)), max(abs(u), abs(v))
    slope = np.float64(low) / np.float64(high) if high > 0 else 0.0
    square = slope * slope
    # Abramowitz and Stegun, Handbook of Mathematical Functions, 4.4.49, divided by a full turn.
    series = 0.9998660 + square * (-0.3302995 + square * (0.1801410 + square * (-0.0851330 + square * 0.0208351)))
    turn = slope * series / (2 * np.pi)
    if abs(v) > abs(u):
        turn = 0.25 - turn
    if u < 0:
        turn = 0.5 - turn
    return 1 - turn if v < 0 else turn


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
            place = int(_find_turn(u, v) * bins + 0.5) % bins
            for k in range(3):
                value = 1 - radius * (1 - wheel[place, k]) if radius <= 1 else 0.75 * wheel[place, k]
                rgb[y, x, k] = np.uint8(255 * value + 0.5)
    return rgb
