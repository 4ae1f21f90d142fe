# SPDX-License-Identifier: Apache-2.0
"""Where a person faces, against a jointed figure of known measures that turns on the spot."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from flowing_puppet_ros.image.tracking.heading import HeadingFilter
from flowing_puppet_ros.image.tracking.settings import TrackerSettings
from flowing_puppet_ros.image.tracking.track import Track
from flowing_puppet_ros.model.ds.multiview import MultiViewStructures
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.shape import View

FIGURE = {
    "neck": (0.0, 0.0, 1.48), "face": (0.10, 0.0, 1.62), "belly": (0.06, 0.0, 1.15),
    "shoulder": (0.0, 0.19, 1.42), "elbow": (0.0, 0.25, 1.13), "wrist": (0.08, 0.24, 0.88),
    "hip": (0.0, 0.11, 0.93), "knee": (0.03, 0.11, 0.50), "ankle": (0.0, 0.11, 0.08),
}  # fmt: skip
"""Forward, to the person's left, and up, metres; a person of 1.75 m by anthropometric tables."""
SCALE = 150.0


@pytest.fixture(scope="module")
def views() -> MultiViewStructures:
    return MultiViewStructures.load("neutral", 10)


def seen_joints(names: tuple[str, ...], heading: float) -> np.ndarray:
    """Return joints (J, 2) px of the figure whose torso faces `heading`: 0 the camera, pi/2 the image's right."""
    places = []
    for name in names:
        side, _, kind = name.partition("_")
        single = side not in ("left", "right")
        forward, left, up = FIGURE[name if single else kind]
        left = left if side == "left" else 0.0 if single else -left
        # Somebody who faces the camera has their left on the right of the image.
        places.append((forward * np.sin(heading) + left * np.cos(heading), -up))
    return 300 + SCALE * np.array(places)


def angle_between(a: float, b: float) -> float:
    return float(abs((a - b + np.pi) % (2 * np.pi) - np.pi))


@pytest.mark.parametrize("degrees", [0, 90, -90, 60, -60, 180, 120, -120])
def test_the_heading_is_that_of_the_figure(views: MultiViewStructures, degrees: float) -> None:
    heading, names = np.radians(degrees), views.views[4].joint_names
    rng = np.random.default_rng(0)
    found = HeadingFilter(views)
    view: View = "front" if abs(degrees) <= 90 else "back"
    for _ in range(20):
        found.update(
            seen_joints(names, heading) + rng.normal(scale=1.5, size=(len(names), 2)), np.ones(len(names)), view
        )
    assert angle_between(found.heading, heading) < np.radians(35)
    assert (found.side_model is not None) == (abs(degrees) == 90)


def test_who_turns_is_drawn_from_the_side_and_then_from_the_front_again(views: MultiViewStructures) -> None:
    frontal = DeformableStructures.load("neutral", 10)
    names, settings = frontal.joint_names, TrackerSettings()
    rng = np.random.default_rng(1)
    track, sides, widths = None, [], []
    for degrees in (*np.linspace(0, 90, 40), *[90] * 20, *np.linspace(90, 0, 40), *[0] * 20):
        joints = seen_joints(names, np.radians(degrees)) + rng.normal(scale=1.0, size=(len(names), 2))
        confidence = np.ones(len(names))
        if track is None:
            track = Track.start("a1", frontal, joints, confidence, settings, HeadingFilter(views))
        track.fuse(joints, confidence, settings)
        track.update_scale_and_view(frontal)
        track.complete_and_redraw(frontal)
        assert track.shape is not None
        sides.append(track.choose_model(frontal) is not frontal)
        widths.append(float(np.ptp(track.shape.contours[0][:, 0])))
    assert sides[59] and not sides[0] and not sides[-1]
    assert widths[59] < 0.8 * widths[0]
    assert widths[-1] == pytest.approx(widths[0], rel=0.1)
    assert sum(a != b for a, b in pairwise(sides)) <= 4, "it does not flicker"


def test_too_few_joints_say_nothing(views: MultiViewStructures) -> None:
    found, count = HeadingFilter(views), len(views.views[4].joint_names)
    found.update(np.full((count, 2), np.nan), np.zeros(count), "front")
    assert found.side_model is None
    assert found.heading == pytest.approx(0.0, abs=0.1)
