# SPDX-License-Identifier: Apache-2.0
"""SVG plots: well-formed, to scale, and silent when there is nothing to show."""

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from flowing_puppet_ros.draw.plots import (
    HEIGHT,
    LEFT,
    MAX_POINTS,
    RIGHT,
    TOP,
    WIDTH,
    Series,
    colour_ramp,
    draw_heat_strip,
    draw_line_plot,
    ticks,
)

X = np.arange(5.0)


def svg_of(html: str) -> ElementTree.Element:
    return ElementTree.fromstring(html[: html.index("</svg>") + 6])


def points(html: str) -> np.ndarray:
    path = re.search(r' d="M([^"]*)" class="line s0"', html)
    assert path is not None
    return np.array([[float(v) for v in point.split(",")] for point in re.split("[ML]", path.group(1))])


def test_line_plot_is_to_scale() -> None:
    html = draw_line_plot([Series("<error>", X, 2 * X)], "Error & more", "time [s]", "px")
    assert svg_of(html).tag == "svg"
    assert "&lt;error&gt;" in html and "Error &amp; more" in html
    drawn = points(html)
    assert drawn[0, 0] == LEFT and drawn[-1, 0] == WIDTH - RIGHT
    assert np.allclose(np.diff(drawn[:, 1]), np.diff(drawn[:, 1])[0], atol=0.11)
    assert TOP < drawn[-1, 1] < drawn[0, 1] < HEIGHT


def test_unknown_values_break_the_line_and_single_points_are_dots() -> None:
    y = np.array([1.0, 2.0, np.nan, 3.0, np.nan])
    html = draw_line_plot([Series("a", X, y)], "t", "x", "y")
    assert html.count("<circle") == 1 and len(points(html)) == 2
    assert "nan" not in html.lower()


def test_nothing_known_gives_nothing() -> None:
    assert draw_line_plot([Series("a", X, np.full(5, np.nan))], "t", "x", "y") == ""
    assert draw_line_plot([], "t", "x", "y") == ""
    assert draw_heat_strip([], np.zeros((0, 0)), np.zeros(0), "t", "x") == ""


def test_constant_lines_and_single_frames_can_be_drawn() -> None:
    for y in (np.zeros(5), np.full(5, -3.0), np.full(5, 1e9)):
        assert "nan" not in draw_line_plot([Series("a", X, y)], "t", "x", "y", from_zero=False).lower()
    assert "<circle" in draw_line_plot([Series("a", X[:1], X[:1])], "t", "x", "y")
    assert "<svg" in draw_heat_strip(["torso"], np.ones((1, 1)), np.zeros(1), "t", "x")


def test_long_lines_are_averaged() -> None:
    x = np.arange(5000.0)
    drawn = points(draw_line_plot([Series("a", x, x)], "t", "x", "y"))
    assert len(drawn) == MAX_POINTS
    assert np.allclose(np.diff(drawn[:, 1]), np.diff(drawn[:, 1]).mean(), atol=0.11)


@pytest.mark.parametrize(("low", "high"), [(0, 1), (-3.2, 17), (0.001, 0.0017), (1e6, 4e6)])
def test_ticks_are_round_and_inside(low: float, high: float) -> None:
    values = ticks(low, high)
    assert 2 <= len(values) <= 7 and min(values) >= low - 1e-9 and max(values) <= high + 1e-9
    step = np.diff(values)
    assert np.allclose(step, step[0])
    mantissa = step[0] / 10 ** np.floor(np.log10(step[0] * (1 + 1e-9)))
    assert min(abs(mantissa - round_number) for round_number in (1, 2, 5)) < 1e-6


def test_heat_strip_names_its_rows() -> None:
    html = draw_heat_strip(["torso", "left_hand"], np.array([[0, 0.5], [np.nan, 1]]), X[:2], "confidence", "time [s]")
    texts = [element.text for element in svg_of(html).iter("text")]
    assert {"torso", "left_hand", "time [s]"} <= set(texts)


def test_ramp_gets_lighter() -> None:
    lightness = colour_ramp(np.linspace(0, 1, 20)) @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness) > 0).all()
