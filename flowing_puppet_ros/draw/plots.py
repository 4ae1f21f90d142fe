# SPDX-License-Identifier: Apache-2.0
"""Time plots as inline SVG text, without a plotting library; CSS decides the colours.

Lines have the classes `s0` to `s7`, and text and axes the current colour, so that one file fits light and dark pages.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from flowing_puppet_ros.draw.pictures import encode_data_uri

WIDTH, HEIGHT = 720, 230  # of a plot, px
LEFT, RIGHT, TOP, BOTTOM = 62, 12, 12, 40  # margins around the axes, px
MAX_POINTS = 600  # points of a line; more are averaged in bins
SERIES_CLASSES = 8  # CSS classes of lines; more lines repeat them

# Dark blue to grey to yellow: the lightness rises evenly, so that it can be read without colour vision.
_RAMP = np.array([(0, 32, 77), (66, 78, 108), (124, 123, 120), (188, 175, 111), (255, 233, 69)], float)


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """One line of a plot: `y` (T,) over `x` (T,); NaN leaves a gap."""

    name: str
    x: np.ndarray
    y: np.ndarray


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Return about `count` round numbers from low to high, 1, 2 or 5 times a power of ten apart."""
    span = high - low
    if not (math.isfinite(span) and span > 0):
        return [low] if math.isfinite(low) else []
    raw = span / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * (1 - 1e-9))
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def draw_line_plot(series: Sequence[Series], title: str, x_label: str, y_label: str, from_zero: bool = True) -> str:
    """Plot lines over a common x; return an `<svg>`, or an empty string when no value is known.

    `from_zero` puts zero on the y axis. Lines of more than MAX_POINTS points are averaged in bins.
    """
    lines = [_downsample(line) for line in series if np.isfinite(line.y).any()]
    if not lines:
        return ""
    x_low, x_high = _finite_range([line.x for line in lines])
    y_low, y_high = _finite_range([line.y for line in lines])
    if from_zero:
        y_low, y_high = min(y_low, 0.0), max(y_high, 0.0)
    if y_high <= y_low:
        y_low, y_high = y_low - 0.5, y_high + 0.5
    y_low, y_high = y_low - 0.03 * (y_high - y_low) * (y_low != 0), y_high + 0.05 * (y_high - y_low)
    frame = _Axes(x_low, x_high if x_high > x_low else x_low + 1, y_low, y_high)
    body = [frame.axes(x_label, y_label)]
    body += [frame.line(line, index % SERIES_CLASSES) for index, line in enumerate(lines)]
    names = ", ".join(line.name for line in lines)
    svg = _wrap_svg(f"{title}: {names}", HEIGHT, "".join(body), (LEFT, WIDTH - RIGHT, frame.x_low, frame.x_high))
    return svg + _make_legend([line.name for line in lines])


def draw_heat_strip(names: Sequence[str], values: np.ndarray, x: np.ndarray, title: str, x_label: str) -> str:
    """Draw `values` (N, T) in [0, 1] as one row of colours per name over `x` (T,); NaN is left empty.

    Return an `<svg>` with its colour scale, or an empty string when there is nothing to show.
    """
    values = np.asarray(values, float)
    if values.size == 0 or not np.isfinite(values).any():
        return ""
    step = max(1, -(-values.shape[1] // MAX_POINTS))
    values, x = values[:, ::step], np.asarray(x, float)[::step]
    left, cell = 130, 16
    height = TOP + cell * len(names) + BOTTOM
    width = WIDTH - left - RIGHT
    known = np.isfinite(values)
    image = np.where(known[..., None], colour_ramp(np.where(known, values, 0)), 255).astype(np.uint8)
    body = [
        f'<image x="{left}" y="{TOP}" width="{width}" height="{cell * len(names)}" preserveAspectRatio="none" '
        f'style="image-rendering:pixelated" href="{encode_data_uri(image, "png")}"/>'
    ]
    for row, name in enumerate(names):
        y = TOP + cell * (row + 0.5)
        body.append(f'<text x="{left - 6}" y="{y:.1f}" class="tick end mid">{escape(name)}</text>')
    high = x[-1] if x[-1] > x[0] else x[0] + 1
    for value in ticks(x[0], high, 8):
        at = left + width * (value - x[0]) / (high - x[0])
        body.append(f'<text x="{at:.1f}" y="{height - BOTTOM + 15}" class="tick centre">{value:g}</text>')
    body.append(f'<text x="{left + width / 2:.1f}" y="{height - 6}" class="tick centre">{escape(x_label)}</text>')
    return _wrap_svg(title, height, "".join(body), (left, WIDTH - RIGHT, x[0], high)) + _make_colour_scale()


def colour_ramp(values: np.ndarray) -> np.ndarray:
    """Return the colours (..., 3), 0 to 255, of `values` (...) in [0, 1]: dark blue is low, yellow is high."""
    position = np.clip(values, 0, 1) * (len(_RAMP) - 1)
    return np.stack([np.interp(position, np.arange(len(_RAMP)), channel) for channel in _RAMP.T], axis=-1)


@dataclass(frozen=True, slots=True)
class _Axes:
    """The ranges of the axes, and the conversion of values to pixels."""

    x_low: float
    x_high: float
    y_low: float
    y_high: float

    def x(self, value: np.ndarray | float) -> np.ndarray | float:
        return LEFT + (WIDTH - LEFT - RIGHT) * (value - self.x_low) / (self.x_high - self.x_low)

    def y(self, value: np.ndarray | float) -> np.ndarray | float:
        return HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * (value - self.y_low) / (self.y_high - self.y_low)

    def axes(self, x_label: str, y_label: str) -> str:
        parts = []
        for value in ticks(self.y_low, self.y_high):
            y = self.y(value)
            parts.append(f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}" class="grid"/>')
            parts.append(f'<text x="{LEFT - 6}" y="{y:.1f}" class="tick end mid">{value:.6g}</text>')
        for value in ticks(self.x_low, self.x_high, 8):
            x = self.x(value)
            parts.append(f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 16}" class="tick centre">{value:.6g}</text>')
        middle = (TOP + HEIGHT - BOTTOM) / 2
        parts.append(f'<text x="{(LEFT + WIDTH) / 2}" y="{HEIGHT - 6}" class="tick centre">{escape(x_label)}</text>')
        turn = f'transform="rotate(-90 14 {middle})"'
        parts.append(f'<text x="14" y="{middle}" class="tick centre" {turn}>{escape(y_label)}</text>')
        return "".join(parts)

    def line(self, series: Series, colour: int) -> str:
        known = np.isfinite(series.y)
        xs, ys = np.asarray(self.x(series.x)), np.asarray(self.y(np.where(known, series.y, 0)))
        pieces, dots = [], []
        for run in _split_runs(known):
            points = [f"{xs[k]:.1f},{ys[k]:.1f}" for k in run]
            if len(points) > 1:
                pieces.append("M" + "L".join(points))
            else:
                dots.append(f'<circle cx="{xs[run[0]]:.1f}" cy="{ys[run[0]]:.1f}" r="3" class="d{colour}"/>')
        path = f'<path d="{"".join(pieces)}" class="line s{colour}"/>' if pieces else ""
        return path + "".join(dots)


def _split_runs(known: np.ndarray) -> list[np.ndarray]:
    """Return the indices of the known values, one array for each unbroken run."""
    indices = np.flatnonzero(known)
    runs = np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1)
    return [run for run in runs if run.size]


def _downsample(series: Series) -> Series:
    x, y = np.asarray(series.x, float), np.asarray(series.y, float)
    if len(x) <= MAX_POINTS:
        return Series(series.name, x, y)
    bins = np.arange(len(x)) * MAX_POINTS // len(x)
    known = np.isfinite(y)
    count = np.bincount(bins, known)
    total = np.bincount(bins, np.where(known, y, 0))
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return Series(series.name, np.bincount(bins, x) / np.bincount(bins), mean)


def _finite_range(arrays: Sequence[np.ndarray]) -> tuple[float, float]:
    values = np.concatenate(arrays)
    values = values[np.isfinite(values)]
    return float(values.min()), float(values.max())


def _wrap_svg(title: str, height: float, body: str, span: tuple[float, float, float, float]) -> str:
    """Return a plot; `span` has the columns of its left and right end and x there, for the timeline's mark."""
    ends = " ".join(f"{value:.6g}" for value in span)
    mark = f'<line class="now" x1="{span[0]}" x2="{span[0]}" y1="{TOP}" y2="{height - BOTTOM}"/>'
    return (
        f'<svg class="plot" viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{escape(title)}" data-time="{ends}">'
        f"<title>{escape(title)}</title>{body}{mark}</svg>"
    )


def _make_legend(names: Sequence[str]) -> str:
    items = "".join(
        f'<span><i class="key k{index % SERIES_CLASSES}"></i>{escape(name)}</span>' for index, name in enumerate(names)
    )
    return f'<p class="legend">{items}</p>'


def _make_colour_scale() -> str:
    image = encode_data_uri(np.rint(colour_ramp(np.linspace(0, 1, 64)))[None].astype(np.uint8), "png")
    return f'<p class="legend"><span>0 <img class="ramp" alt="dark is low, light is high" src="{image}"> 1</span></p>'
