# SPDX-License-Identifier: Apache-2.0
"""Dense flow of known shifts, on the working grid and the image's, and its behaviour on bad input."""

import threading

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.flow.estimate import OpticalFlow, resize_flow, working_size
from flowing_puppet_ros.flow.settings import FlowSettings


def texture(height: int, width: int) -> NDArray[np.uint8]:
    """A grey image with structure at several scales."""
    rng = np.random.default_rng(5)
    layers = [
        cv2.resize(rng.uniform(0, 255, (height // k, width // k)), (width, height), interpolation=cv2.INTER_CUBIC)
        for k in (4, 9, 21)
    ]
    return np.clip(np.mean(layers, axis=0), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("preset", ["ultrafast", "fast", "medium"])
def test_shift_to_the_right_and_down_is_positive(preset: str) -> None:
    image = texture(220, 300)
    flow = OpticalFlow(FlowSettings(preset=preset))
    forward, backward = flow(image[8:208, 8:288], image[3:203, 2:282])
    assert forward.shape == (200, 280, 2)
    assert forward.dtype == np.float32
    np.testing.assert_allclose(np.median(forward, axis=(0, 1)), [6, 5], atol=0.3)
    np.testing.assert_allclose(np.median(backward, axis=(0, 1)), [-6, -5], atol=0.3)


def test_large_images_are_reduced_and_the_flow_stays_in_their_pixels() -> None:
    big = cv2.resize(texture(220, 300), None, fx=4, fy=4, interpolation=cv2.INTER_LINEAR)
    rgb = np.repeat(big[..., None], 3, axis=2)
    flow = OpticalFlow(FlowSettings(max_side=300))
    forward, _ = flow(rgb[:, 40:], rgb[:, :-40])
    assert forward.shape == (880, 1160, 2)
    np.testing.assert_allclose(np.median(forward, axis=(0, 1)), [40, 0], atol=1.5)
    small, _ = flow.estimate_at_working_scale(rgb[:, 40:], rgb[:, :-40])
    assert small.shape == (228, 300, 2)
    np.testing.assert_allclose(np.median(small, axis=(0, 1)), [40 * 300 / 1160, 0], atol=0.4)


def test_same_bits_with_any_number_of_threads() -> None:
    image = texture(220, 300)
    expected = OpticalFlow()(image[:, :280], image[:, 9:289])
    results: list[object] = []

    def estimate() -> None:
        cv2.setNumThreads(4)
        results.append(OpticalFlow()(image[:, :280], image[:, 9:289]))

    threads = [threading.Thread(target=estimate) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 3
    for result in results:
        np.testing.assert_array_equal(result, expected)


def test_resized_flow_scales_its_vectors_and_keeps_unknown_ones() -> None:
    field = np.full((20, 40, 2), (4.0, 2.0), np.float32)
    field[:, 20:] = np.nan
    half = resize_flow(field, (20, 5))
    np.testing.assert_allclose(half[:, :9], np.full((5, 9, 2), (2.0, 0.5)), rtol=1e-6)
    assert np.isnan(half[:, 11:]).all()


def test_working_size_keeps_the_aspect_and_never_enlarges() -> None:
    assert working_size((1920, 1080, 3), 640) == (360, 640)
    assert working_size((480, 640), 640) == (640, 480)
    assert working_size((240, 320), 640) == (320, 240)


@pytest.mark.parametrize(
    "image",
    [np.zeros((0, 0), np.uint8), np.zeros((50, 50), np.float32), np.zeros((50, 50, 4), np.uint8)],
)
def test_what_is_no_image_is_refused_in_a_sentence(image: NDArray[np.uint8]) -> None:
    with pytest.raises(InputError, match=r"^an image must be .*, this one is"):
        OpticalFlow().prepare(image)


def test_two_sizes_are_refused() -> None:
    with pytest.raises(InputError, match="one size"):
        OpticalFlow()(np.zeros((50, 50), np.uint8), np.zeros((50, 60), np.uint8))
