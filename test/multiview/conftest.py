# SPDX-License-Identifier: Apache-2.0
"""Cameras around a person, for the tests of this folder."""

from collections.abc import Callable

import numpy as np
import pytest

from flowing_puppet_ros.multiview.camera import Camera


def _look_at(eye: np.ndarray, focal: float, size: tuple[int, int], lens: tuple[float, ...]) -> Camera:
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, (0, 0, 1.0))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    k = [focal, 0, (size[0] - 1) / 2, 0, focal, (size[1] - 1) / 2, 0, 0, 1]
    return Camera.from_info(k, lens, *size, rotation, -rotation @ eye)


@pytest.fixture
def ring() -> Callable[..., list[Camera]]:
    """Cameras on a circle of 3 m around the origin, alternately 0.6 m below and above it, all looking there."""

    def make(
        count: int, focal: float = 300.0, size: tuple[int, int] = (240, 320), lens: tuple[float, ...] = ()
    ) -> list[Camera]:
        angles = 2 * np.pi * np.arange(count) / count + 0.1
        eyes = [np.array([3 * np.cos(a), 3 * np.sin(a), 0.6 if i % 2 else -0.6]) for i, a in enumerate(angles)]
        return [_look_at(eye, focal, size, lens) for eye in eyes]

    return make
