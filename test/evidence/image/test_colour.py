# SPDX-License-Identifier: Apache-2.0
"""Colour models on pictures of known colours."""

import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.image.colour import BINS, MAX_LOG_RATIO, ColourImage, SkinColour, torso_map

RED, BLUE, GREEN, GREY = (200, 60, 60), (50, 60, 190), (70, 170, 60), (120, 120, 120)
RNG = np.random.default_rng(0)


def picture(*patches: tuple[tuple[int, int, int], slice, slice]) -> np.ndarray:
    """Grey with noise, and coloured patches on it."""
    image = np.full((120, 160, 3), GREY)
    for colour, rows, columns in patches:
        image[rows, columns] = colour
    return np.clip(image + RNG.integers(-6, 7, image.shape), 0, 255).astype(np.uint8)


def box(left: float, top: float, right: float, bottom: float) -> np.ndarray:
    """Outline (40, 2) of a rectangle from the middle of its top, clockwise."""
    across, down = np.linspace(left, right, 10, endpoint=False), np.linspace(top, bottom, 10, endpoint=False)
    edges = [(x, top) for x in across] + [(right, y) for y in down]
    edges += [(right + left - x, bottom) for x in across] + [(left, bottom + top - y) for y in down]
    return np.roll(np.array(edges, float), -5, axis=0)


SCENE = picture(
    (RED, slice(10, 40), slice(60, 90)),  # face
    (BLUE, slice(40, 110), slice(50, 100)),  # shirt
    (BLUE, slice(50, 90), slice(110, 125)),  # sleeve
    (RED, slice(90, 110), slice(110, 125)),  # hand
    (GREEN, slice(0, 120), slice(140, 160)),
)
HEAD, TORSO = box(58, 8, 92, 42), box(50, 40, 100, 110)


def test_the_torso_map_knows_sleeves_and_bare_arms() -> None:
    values = torso_map(ColourImage.of(SCENE), TORSO, HEAD).values
    sleeve, hand = values[55:85, 112:123].mean(), values[92:108, 112:123].mean()
    elsewhere, green = values[:, 5:40].mean(), values[:, 145:158].mean()
    assert sleeve > 0.5 and hand > 0.5
    assert elsewhere < -1.0 and green < -1.0


def test_the_upper_torso_counts_not_the_trousers() -> None:
    image = picture((BLUE, slice(40, 75), slice(50, 100)), (GREEN, slice(78, 110), slice(50, 100)))
    values = torso_map(ColourImage.of(image), TORSO, HEAD).values
    assert values[45:70, 60:90].mean() > 0.5 > 0.0 > values[82:108, 60:90].mean()


def test_skin_takes_the_colour_of_the_face() -> None:
    colours = ColourImage.of(SCENE)
    unsure = SkinColour(np.zeros(BINS * BINS))
    assert not unsure.map(colours).values.any()
    values = unsure.map(colours, HEAD).values
    assert values[92:108, 112:123].mean() > 0.5 > 0.0 > values[55:85, 112:123].mean()


def test_learned_skin_is_looked_up() -> None:
    colours = ColourImage.of(SCENE)
    table = np.zeros(BINS * BINS)
    table[colours.bins[25, 75]] = 2.0
    values = SkinColour(table).map(colours).values
    np.testing.assert_array_equal(values, np.where(colours.bins == colours.bins[25, 75], 2.0, 0.0))


@pytest.mark.parametrize("head", [box(500, 500, 520, 520), np.full((40, 2), np.nan), box(10, 10, 11, 11)])
def test_faces_outside_the_image_change_nothing(head: np.ndarray) -> None:
    colours = ColourImage.of(SCENE)
    skin = SkinColour(np.linspace(-1, 1, BINS * BINS))
    np.testing.assert_array_equal(skin.map(colours, head).values, skin.map(colours).values)
    assert not torso_map(colours, head, head).values.any()


def test_grey_images_are_neutral() -> None:
    grey = RNG.integers(0, 255, (60, 80)).astype(np.uint8)
    values = torso_map(ColourImage.of(grey), box(20, 20, 50, 50), box(25, 5, 45, 20)).values
    assert np.ptp(values) < 0.01 and np.abs(values).max() < 0.01


def test_limits_and_tiny_images() -> None:
    assert np.abs(torso_map(ColourImage.of(SCENE), TORSO, HEAD).values).max() <= MAX_LOG_RATIO
    one = ColourImage.of(np.full((1, 1, 3), 9, np.uint8))
    assert one.histogram.sum() == pytest.approx(1.0)
    assert torso_map(one, TORSO, HEAD).values.shape == (1, 1)
    with pytest.raises(InputError, match="RGB or grey"):
        ColourImage.of(np.zeros((3, 3), float))
