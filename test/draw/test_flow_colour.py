# SPDX-License-Identifier: Apache-2.0
"""The flow wheel: direction to hue, magnitude to saturation."""

import colorsys

import numpy as np
import pytest

from flowing_puppet_ros.draw.flow_colour import _find_turn, draw_flow_legend, flow_scale, flow_to_rgb


def colour(u: float, v: float, scale: float = 1.0) -> tuple[int, int, int]:
    red, green, blue = flow_to_rgb(np.array([[[u, v]]], np.float32), scale)[0, 0]
    return int(red), int(green), int(blue)


def test_key_directions() -> None:
    assert colour(1, 0) == (255, 0, 0)
    red, green, blue = colour(0, 1)  # down
    assert red > 230 and green > 200 and blue == 0
    red, green, blue = colour(-1, 0)
    assert red == 0 and blue == 255 and 100 < green < 230
    red, green, blue = colour(0, -1)  # up
    assert blue == 255 and green == 0 and 50 < red < 200


def test_saturation_grows_with_magnitude_and_hue_stays() -> None:
    hues, saturations = [], []
    for magnitude in (0.25, 0.5, 1.0):
        hue, saturation, value = colorsys.rgb_to_hsv(*(c / 255 for c in colour(0.6 * magnitude, -0.8 * magnitude)))
        hues.append(hue)
        saturations.append(saturation)
        assert value == pytest.approx(1.0)
    assert saturations == pytest.approx([0.25, 0.5, 1.0], abs=0.01)
    assert np.ptp(hues) < 0.02


def test_still_is_white_unknown_is_black_and_fast_is_darker() -> None:
    assert colour(0, 0) == (255, 255, 255)
    assert colour(np.nan, 0.5) == (0, 0, 0)
    assert colour(3, 0) == (191, 0, 0)


def test_hue_is_continuous_around_the_circle() -> None:
    angle = np.linspace(0, 2 * np.pi, 721)
    flow = np.stack([np.cos(angle), np.sin(angle)], axis=-1)[None]
    steps = np.abs(np.diff(flow_to_rgb(flow, 1.0)[0].astype(int), axis=0))
    assert steps.max() <= 16


def test_scale_ignores_unknown_pixels_and_outliers() -> None:
    flow = np.zeros((100, 100, 2), np.float32)
    flow[..., 0] = 4.0
    flow[0, :50] = 500.0
    flow[1, :] = np.nan
    assert flow_scale(flow) == pytest.approx(4.0)
    assert flow_scale(np.full((4, 4, 2), np.nan)) == 1.0
    assert flow_scale(np.zeros((4, 4, 2))) == 1.0


def test_legend_shows_the_motion_from_its_centre() -> None:
    legend = draw_flow_legend(101)
    assert (legend[0, 0] == 255).all() and (legend[50, 50] > 245).all()
    assert legend[50, 99, 0] == 255 and legend[50, 99, 1] < 20


def test_directions_are_those_of_the_arctangent() -> None:
    angles = np.linspace(0, 2 * np.pi, 2001)[:-1]
    for radius in (1e-3, 1.0, 300.0):
        turns = np.array([_find_turn(radius * np.cos(angle), radius * np.sin(angle)) for angle in angles])
        apart = np.abs(turns - angles / (2 * np.pi))
        assert np.minimum(apart, 1 - apart).max() < 2e-5
    assert _find_turn(0.0, 0.0) == 0.0
