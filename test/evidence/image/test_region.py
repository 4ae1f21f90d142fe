# SPDX-License-Identifier: Apache-2.0
"""Sums over regions against testing every pixel."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowing_puppet_ros.evidence.image.region import RegionMap

VALUES = np.random.default_rng(0).normal(size=(23, 31))


def brute_force(contour: np.ndarray) -> tuple[float, int]:
    """Sum over the pixels with their centre inside, and their number, by the crossings of a ray to the right."""
    total, count = 0.0, 0
    for y in range(VALUES.shape[0]):
        for x in range(VALUES.shape[1]):
            a, b = contour, np.roll(contour, -1, axis=0)
            crosses = (a[:, 1] > y) != (b[:, 1] > y)
            at = a[:, 0] + (y - a[:, 1]) / np.where(crosses, b[:, 1] - a[:, 1], 1.0) * (b[:, 0] - a[:, 0])
            if np.sum(crosses & (at > x)) % 2:
                total, count = total + VALUES[y, x], count + 1
    return total, count


def star(seed: int, x: float, y: float, size: float) -> np.ndarray:
    """A contour without self-crossings, in either sense."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0, 2 * np.pi, 17, endpoint=False)[:: rng.choice([-1, 1])]
    return (x, y) + size * rng.uniform(0.3, 1.0, (17, 1)) * np.column_stack([np.cos(angle), np.sin(angle)])


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.floats(-12, 40), st.floats(-12, 35), st.floats(0.2, 25))
def test_sums_equal_brute_force(seed: int, x: float, y: float, size: float) -> None:
    contour = star(seed, x, y, size)
    total, count = brute_force(contour)
    found, area = RegionMap.of(VALUES).sums(contour[None])
    assert area[0] == count
    assert found[0] == pytest.approx(total, abs=1e-9)


def test_means_of_several_regions() -> None:
    contours = np.stack([star(1, 15, 11, 6), star(2, 500, 11, 6), star(3, 12, 9, 8), star(4, 1e300, 0, 1)])
    contours[2, 4, 1] = np.nan
    mean = RegionMap.of(VALUES).mean(contours)
    total, count = brute_force(contours[0])
    assert mean[0] == pytest.approx(total / count)
    assert mean[1] == mean[3] == 0.0, "nothing of it is in the image"
    assert np.isnan(mean[2])


def test_one_pixel() -> None:
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    assert RegionMap.of(np.array([[4.0]])).mean(square[None])[0] == 4.0
