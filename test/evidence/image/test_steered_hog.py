# SPDX-License-Identifier: Apache-2.0
"""Orientation maps and steered descriptors against brute force, and what turning and mirroring leave as it is."""

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.image.features import (
    CELL_PX,
    CHANNELS,
    LEVELS_PER_OCTAVE,
    MAX_LEVEL_PIXELS,
    ORDERS,
    ImageFeatures,
    OrientationMap,
)
from flowing_puppet_ros.evidence.image.outline import grow, mirror_order
from flowing_puppet_ros.evidence.image.steered_hog import SIDES, descriptors

SIZE = 64


def blobs(seed: int = 0, size: int = SIZE) -> np.ndarray:
    """A smooth colour picture."""
    coarse = np.random.default_rng(seed).integers(0, 256, (8, 8, 3)).astype(np.uint8)
    return cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC)


def egg(centre: float = 31.5) -> np.ndarray:
    """A closed contour (40, 2) without symmetry that runs as a right part's."""
    angle = np.linspace(0, -2 * np.pi, 40, endpoint=False)
    radius = 14 + 3 * np.cos(angle) + 2 * np.sin(2 * angle)
    return centre + radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])


def of_level(level: OrientationMap, contour: np.ndarray, offset: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    found, visible = descriptors(level, contour[None], np.arange(0, 40, 4), np.array([offset]))
    return found[0], visible[0]


def brute_force(level: OrientationMap, contour: np.ndarray, place: int, side: int, offset: float) -> np.ndarray:
    """The descriptor by its definition, with complex numbers."""
    along = contour[(place + 2) % len(contour)] - contour[place - 2]
    normal = np.array([-along[1], along[0]]) / np.hypot(*along)
    middle = contour.mean(axis=0)
    if normal @ (contour[place] - middle) < 0:
        normal = -normal
    x, y = (contour[place] + (side - 1) * offset * normal + 0.5) * level.scale - 0.5
    height, width = level.values.shape[:2]
    value = np.zeros(CHANNELS)
    for row in (int(np.floor(y)), int(np.floor(y)) + 1):
        for column in (int(np.floor(x)), int(np.floor(x)) + 1):
            share = (1 - abs(x - column)) * (1 - abs(y - row))
            value += share * level.values[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    turn = np.arctan2(normal[1], normal[0])
    mirrored = normal[0] * along[1] - normal[1] * along[0] > 0
    for k in range(1, ORDERS + 1):
        turned = complex(value[2 * k - 1], value[2 * k]) * np.exp(-2j * k * turn)
        value[2 * k - 1], value[2 * k] = turned.real, -turned.imag if mirrored else turned.imag
    return value


@pytest.mark.parametrize("number", [0, -LEVELS_PER_OCTAVE, 3])
@pytest.mark.parametrize("mirror", [False, True])
def test_descriptors_equal_the_definition(number: int, mirror: bool) -> None:
    level = ImageFeatures.of(blobs()).level(number)
    contour = egg() * (-1 if mirror else 1, 1) + (63 if mirror else 0, 0)
    found, visible = of_level(level, contour)
    assert visible.all()
    for index, place in enumerate(range(0, 40, 4)):
        for side in range(SIDES):
            np.testing.assert_allclose(found[index, side], brute_force(level, contour, place, side, 4.0), atol=2e-5)


def test_quarter_turns_and_mirrors_of_image_and_contour_change_nothing() -> None:
    image, contour = blobs(1), egg()
    found, _ = of_level(ImageFeatures.of(image).level(0), contour)
    turned = np.column_stack([contour[:, 1], SIZE - 1 - contour[:, 0]])
    mirrored = np.column_stack([SIZE - 1 - contour[:, 0], contour[:, 1]])
    for picture, outline in ((np.rot90(image), turned), (image[:, ::-1], mirrored)):
        again, _ = of_level(ImageFeatures.of(np.ascontiguousarray(picture)).level(0), outline)
        np.testing.assert_allclose(again, found, atol=2e-3)
    unsteered, _ = of_level(ImageFeatures.of(image).level(0), turned)
    assert np.abs(unsteered - found).max() > 0.1


@pytest.mark.parametrize("degrees", [10.0, 33.0, 77.0])
def test_any_turn_changes_little(degrees: float) -> None:
    size = 129
    image, middle = blobs(2, size), (size - 1) / 2
    contour = 1.5 * (egg() - 31.5) + middle
    move = cv2.getRotationMatrix2D((middle, middle), degrees, 1.0)
    picture = cv2.warpAffine(image, move, (size, size), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    found, _ = of_level(ImageFeatures.of(image).level(0), contour)
    again, _ = of_level(ImageFeatures.of(picture).level(0), contour @ move[:, :2].T + move[:, 2])
    assert np.abs(again - found).mean() < 0.03 < 0.2 * np.abs(found).mean()


def test_an_edge_along_the_contour_has_its_gradient_along_the_normal() -> None:
    image = np.full((SIZE, SIZE, 3), 60, np.uint8)
    contour = egg()
    cv2.fillPoly(image, [np.round(contour).astype(np.int32)], (200, 200, 200))
    on = of_level(ImageFeatures.of(image).level(0), contour)[0][:, 1].mean(axis=0)
    far = of_level(ImageFeatures.of(image).level(0), contour, offset=14.0)[0][:, 2]
    assert on[0] > 0.3 and on[1] > 0.8 * on[0], "cos 2a is 1 where the gradient is normal"
    assert np.abs(on[2]) < 0.1 * on[0], "and sin 2a is 0"
    assert np.abs(far[:, 0]).max() < 0.1 * on[0]


def test_grey_images_are_their_rgb_copies() -> None:
    grey = blobs()[:, :, 0]
    np.testing.assert_array_equal(
        ImageFeatures.of(grey).level(0).values, ImageFeatures.of(np.dstack([grey] * 3)).level(0).values
    )


def test_contrast_and_brightness_matter_little() -> None:
    image = blobs(4)
    dim = (image // 3 + 40).astype(np.uint8)
    bright, dark = (ImageFeatures.of(picture).level(0).values for picture in (image, dim))
    assert np.abs(bright - dark).mean() < 0.2 * np.abs(bright).mean()


def test_what_lies_outside_the_image_is_not_seen() -> None:
    level = ImageFeatures.of(blobs()).level(0)
    shifted = egg() - (31.5, 0)
    found, visible = of_level(level, shifted)
    np.testing.assert_array_equal(visible[:, 1], shifted[::4, 0] >= -0.5)
    assert visible.any() and not visible.all() and not found[~visible].any()
    assert not of_level(level, egg() + 1000)[1].any()


def test_broken_contours_have_no_descriptors() -> None:
    level = ImageFeatures.of(blobs()).level(0)
    for value in (np.nan, np.inf):
        contour = egg()
        contour[3, 0] = value
        found, _ = of_level(level, contour)
        assert np.isfinite(found).all()
    found, _ = of_level(level, np.full((40, 2), 30.0))
    assert np.isfinite(found).all()


def test_levels_follow_the_cell_and_the_size_of_the_image() -> None:
    features = ImageFeatures.of(blobs())
    np.testing.assert_array_equal(
        features.find_levels(CELL_PX * np.array([1.0, 2.0, 1.1, 8.0])), [0, LEVELS_PER_OCTAVE, 1, 3 * LEVELS_PER_OCTAVE]
    )
    np.testing.assert_array_equal(features.find_levels(np.array([1e-6, 1e6]))[0], -LEVELS_PER_OCTAVE)
    large = ImageFeatures.of(np.zeros((3000, 4000, 3), np.uint8))
    finest = int(large.find_levels(np.array([0.1]))[0])
    assert (
        12e6 * 4.0 ** (-finest / LEVELS_PER_OCTAVE)
        <= MAX_LEVEL_PIXELS
        < 12e6 * 4.0 ** (-(finest - 1) / LEVELS_PER_OCTAVE)
    )
    assert features.level(100).values.shape == (1, 1, CHANNELS)


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 1), (1, 50, 3), (2, 3)])
def test_tiny_images_have_maps(shape: tuple[int, ...]) -> None:
    features = ImageFeatures.of(np.full(shape, 90, np.uint8))
    for number in (-LEVELS_PER_OCTAVE, 0, 9):
        assert np.isfinite(features.level(number).values).all()


@pytest.mark.parametrize("image", [np.zeros((0, 5, 3), np.uint8), np.zeros((4, 4, 4), np.uint8), np.zeros((4, 4))])
def test_other_arrays_are_refused_in_a_sentence(image: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"^an image must be .*, this one is"):
        ImageFeatures.of(image)


def test_grown_contours_lie_outside_by_the_distance() -> None:
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    circle = 10 * np.column_stack([np.cos(angle), np.sin(angle)])
    for contour in (circle, mirror_order(circle)):
        (larger,) = grow(contour[None], np.array([3.0]))
        np.testing.assert_allclose(np.hypot(*larger.T), 13.0, atol=1e-9)
    np.testing.assert_array_equal(mirror_order(mirror_order(circle)), circle)
    np.testing.assert_array_equal(mirror_order(circle)[0], circle[0])
