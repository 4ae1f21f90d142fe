# SPDX-License-Identifier: Apache-2.0
"""Cuts are distinguished from motion, pans, brightening and still pictures."""

import cv2
import numpy as np

from flowing_puppet_ros.flow.estimate import OpticalFlow
from flowing_puppet_ros.image.tracking.shot_boundary import colour_change, colour_histogram, flow_inconsistency, is_cut

FLOW = OpticalFlow()


def scene(seed: int) -> np.ndarray:
    """Blotches of some colours."""
    rng = np.random.default_rng(seed)
    few = rng.integers(0, 256, (9, 12, 3)) * rng.uniform(0.3, 1.0, 3)
    return np.asarray(cv2.resize(few.astype(np.uint8), (320, 240), interpolation=cv2.INTER_CUBIC))


def cut(before: np.ndarray, after: np.ndarray) -> bool:
    return is_cut(colour_histogram(before), colour_histogram(after), FLOW.estimate_at_working_scale(before, after))


def test_another_scene_is_a_cut() -> None:
    assert all(cut(scene(seed), scene(seed + 1)) for seed in range(4))


def test_motion_zoom_and_light_are_none() -> None:
    image = scene(0)
    for move in ([[1, 0, 14], [0, 1, -9]], [[1.08, 0, -8], [0, 1.08, -8]]):
        moved = cv2.warpAffine(image, np.array(move, float), (320, 240), borderMode=cv2.BORDER_REFLECT)
        assert not cut(image, moved)
    assert not cut(image, np.clip(image.astype(float) * 1.25, 0, 255).astype(np.uint8))
    assert not cut(image, image)
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    assert not cut(grey, grey)


def test_measures_at_their_ends() -> None:
    black, white = np.zeros((40, 60, 3), np.uint8), np.full((40, 60, 3), 255, np.uint8)
    assert colour_change(colour_histogram(black), colour_histogram(black)) == 0.0
    assert colour_change(colour_histogram(black), colour_histogram(white)) == 1.0
    assert colour_change(colour_histogram(black), colour_histogram(black[..., 0])) == 1.0
    still = np.zeros((40, 60, 2), np.float32)
    assert flow_inconsistency((still, still)) == 0.0
    assert flow_inconsistency((still + 100, still)) == 1.0
    assert flow_inconsistency((still + np.nan, still)) == 1.0
