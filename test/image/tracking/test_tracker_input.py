# SPDX-License-Identifier: Apache-2.0
"""The tracker on odd and bad input: nothing breaks it, and it says what it leaves out."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from drawn_people import NAMES, CapsuleModel, Floats, capsule, detection, draw, error, pose, tracker  # type: ignore[import-not-found]
from numpy.typing import NDArray

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.flow.estimate import OpticalFlow
from flowing_puppet_ros.flow.settings import FlowSettings
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.tracking.tracker import FlowingPuppetTracker


def test_given_flow_is_used_at_any_resolution() -> None:
    images = [draw(pose(time)) for time in (0, 4)]
    forward, backward = OpticalFlow()(images[0], images[1])
    results = []
    twice = [np.repeat(np.repeat(field, 2, axis=0), 2, axis=1) * 2 for field in (forward, backward)]
    for flow in (None, (forward, backward), (twice[0], twice[1])):
        follower = tracker()
        follower.step(images[0], 0, [detection(pose(0))])
        results.append(follower.step(images[1], 1, None, flow).puppets[0].joints)
    np.testing.assert_array_equal(results[0], results[1])
    np.testing.assert_allclose(results[2], results[0], atol=1.0)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda image: (np.full((4, 4, 2), np.nan, np.float32),) * 2,
        lambda image: (np.zeros((10, 10), np.float32),) * 2,
        lambda image: (np.full((240, 320, 2), 1e30, np.float32),) * 2,
    ],
)
def test_useless_flow_does_no_harm(spoil: Callable[[NDArray[np.uint8]], tuple[Floats, Floats]]) -> None:
    follower, image = tracker(), draw(pose(0))
    follower.step(image, 0, [detection(pose(0))])
    result = follower.step(image, 1, [detection(pose(0))], spoil(image))  # type: ignore[arg-type]
    assert len(result.puppets) <= 1
    for puppet in result.puppets:
        assert np.isfinite(puppet.joints).all()


def test_backward_stamp_and_new_size_start_anew_with_a_warning() -> None:
    follower, image = tracker(), draw(pose(0))
    follower.step(image, 100, [detection(pose(0))])
    back = follower.step(image, 50)
    assert not back.puppets
    assert len(back.warnings) == 1
    assert "back from 100 to 50" in back.warnings[0]
    follower.step(image, 60, [detection(pose(0))])
    changed = follower.step(cv2.resize(image, (160, 120)), 70)
    assert not changed.puppets
    assert "(320, 240) to (160, 120)" in changed.warnings[0]
    follower.step(image, 80, [detection(pose(0))])
    same = follower.step(image, 80)
    assert [puppet.id for puppet in same.puppets] == ["a3"]
    assert same.warnings


def test_grey_images_are_tracked_too() -> None:
    follower = tracker()
    for time in range(6):
        grey = cv2.cvtColor(draw(pose(time)), cv2.COLOR_RGB2GRAY)
        result = follower.step(grey, time, [detection(pose(0))] if time == 0 else None)
    assert error(result, pose(5), "neck") < 4


@pytest.mark.parametrize(
    "bad",
    [
        Keypoints((), np.zeros((0, 2)), np.zeros(0)),
        Keypoints(("tail", "wing"), np.zeros((2, 2)), np.ones(2)),
        Keypoints(NAMES, np.full((15, 2), np.nan), np.ones(15)),
        Keypoints(NAMES, np.full((15, 2), 1e30), np.ones(15)),
        Keypoints(NAMES, np.full((15, 2), 50.0), np.ones(15)),
        Keypoints(NAMES, np.full((15, 2), 5e4) + np.arange(30).reshape(15, 2), np.ones(15)),
        Keypoints(NAMES, pose(0), np.zeros(15)),
        Keypoints(NAMES, pose(0), np.full(15, np.nan)),
    ],
)
def test_bad_detections_neither_start_nor_disturb_anybody(bad: Keypoints) -> None:
    image = draw(pose(0))
    assert not tracker().step(image, 0, [bad]).puppets
    follower = tracker()
    follower.step(image, 0, [detection(pose(0))])
    result = follower.step(image, 1, [bad, detection(pose(0))])
    assert error(result, pose(0), "left_wrist") < 2
    result = follower.step(image, 2, [bad])
    assert error(result, pose(0), "left_wrist") < 2


@pytest.mark.slow
def test_random_input_never_breaks_the_tracker() -> None:
    chance = np.random.default_rng(8)
    follower = tracker(max_people=3)
    image = draw(pose(0))
    for time in range(40):
        people = []
        for _ in range(chance.integers(0, 5)):
            joints = pose(0, tuple(chance.uniform(-200, 500, 2))) * chance.choice([0.01, 1, 30])
            joints[chance.random(15) < 0.3] = chance.choice([np.nan, np.inf, 0.0, -1e4])
            people.append(Keypoints(NAMES, joints, chance.uniform(-1, 2, 15)))
        result = follower.step(image, time, people if chance.random() < 0.8 else None)
        assert len(result.puppets) <= 3
        for puppet in result.puppets:
            assert np.isfinite(puppet.joints).all()
            assert np.isfinite(puppet.energy)
            assert ((puppet.confidence >= 0) & (puppet.confidence <= 1)).all()
        result.render_part_labels()


@pytest.mark.parametrize("image", [np.zeros((0, 0, 3), np.uint8), np.zeros((9, 9), np.uint8), np.zeros((50, 50, 3))])
def test_what_is_no_image_is_one_sentence(image: NDArray[np.uint8]) -> None:
    with pytest.raises(InputError, match="this one is"):
        tracker().step(image, 0)


def test_small_flow_grid_serves_large_images() -> None:
    images = [cv2.resize(draw(pose(time)), None, fx=2, fy=2) for time in range(5)]
    follower = FlowingPuppetTracker(CapsuleModel(), None, FlowSettings(max_side=320))
    for time, image in enumerate(images):
        result = follower.step(image, time, [detection(2 * pose(0) + 0.5)] if time == 0 else None)
    assert error(result, 2 * pose(4) + 0.5, "neck") < 4
    assert result.flow is not None
    assert result.flow[0].shape == (240, 320, 2)
    contour = capsule(np.zeros(2), np.ones(2), 1.0)
    assert len(result.puppets[0].contours[0]) == len(contour)


def test_a_cut_ends_everybody_and_ids_are_not_used_again() -> None:
    follower = tracker()
    shots = [draw(pose(time)) for time in (0, 1, 2)] + [draw(pose(time))[::-1, ::-1] // 3 for time in (2, 3)]
    ids, warnings = [], []
    for k, image in enumerate(shots):
        result = follower.step(np.ascontiguousarray(image), k, [detection(pose(k))])
        ids.append([puppet.id for puppet in result.puppets])
        warnings.append(result.warnings)
    assert ids == [["a1"], ["a1"], ["a1"], ["a2"], ["a2"]]
    assert [len(said) for said in warnings] == [0, 0, 0, 1, 0]
    assert "cut" in warnings[3][0]
