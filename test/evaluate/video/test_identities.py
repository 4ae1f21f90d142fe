# SPDX-License-Identifier: Apache-2.0
"""Ids of tracked people against annotated ones: which frames, joints and people count."""

import numpy as np
import pytest

from flowing_puppet_ros.evaluate.people import Unmatched
from flowing_puppet_ros.evaluate.video.identities import measure_identities
from flowing_puppet_ros.image.formats.keypoints import Keypoints

NAMES = ("left_shoulder", "right_shoulder", "left_wrist", "belly")
PLACES = np.array([[40.0, 10.0], [10.0, 10.0], [40.0, 90.0], [25.0, 70.0]])
SIZE = (320, 240)


def joints(x: float) -> dict[str, np.ndarray]:
    return dict(zip(NAMES, PLACES + np.array([x, 0.0]), strict=True))


def person(x: float) -> Keypoints:
    return Keypoints(NAMES, PLACES + np.array([x, 0.0]), np.ones(len(NAMES)))


def test_places_in_the_list_are_identities_and_only_annotated_frames_count() -> None:
    track = {k: {"p": joints(0.0), "q": joints(150.0)} for k in range(10)}
    truth = {k: [person(0.0), person(150.0)] for k in (0, 3, 6)}
    counts = measure_identities(track, truth, SIZE, "wrong")
    assert (counts.true, counts.found, counts.same, counts.switches) == (6, 6, 6, 0)
    truth[6] = [person(150.0), person(0.0)]
    counts = measure_identities(track, truth, SIZE, "wrong")
    assert (counts.kept, counts.same, counts.switches) == (6, 4, 2)


@pytest.mark.parametrize(("unmatched", "found"), [("wrong", 6), ("unknown", 3)])
def test_bystanders(unmatched: Unmatched, found: int) -> None:
    track = {k: {"p": joints(0.0), "q": joints(150.0)} for k in range(3)}
    counts = measure_identities(track, {k: [person(1.0)] for k in range(3)}, SIZE, unmatched)
    assert (counts.true, counts.found, counts.kept) == (3, found, 3)


def test_joints_outside_the_image_are_not_asked() -> None:
    far = joints(0.0) | {"left_wrist": np.array([300.0, 200.0])}
    truth = {0: [person(0.0)]}
    apart = measure_identities({0: {"p": far}}, truth, SIZE, "wrong")
    cut = measure_identities({0: {"p": far}}, truth, (320, 80), "wrong")
    # Two of three joints are right: matches up to 0.65; without the wrist all are.
    assert apart.matches.sum() == 13 and cut.matches.sum() == 19
    nobody = measure_identities({0: {"p": far}}, truth, (5, 5), "wrong")
    assert (nobody.true, nobody.found) == (0, 1)


def test_nobody_is_tracked() -> None:
    counts = measure_identities({}, {0: [person(0.0)], 1: []}, SIZE, "unknown")
    assert (counts.true, counts.found) == (1, 0)
