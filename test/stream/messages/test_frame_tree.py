# SPDX-License-Identifier: Apache-2.0
"""Frames that move: poses between stamps, at stamps that are not known, and of recordings that begin again."""

from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.geometry import FrameTree, make_header, make_transform
from flowing_puppet_ros.stream.messages.message_types import TRANSFORMS

FACTORY = BagMessageFactory()
SECOND = 1_000_000_000


def turned(degrees: float) -> np.ndarray:
    """Return a rotation about z."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def link(seconds: float, parent: str, child: str, x: float, degrees: float = 0.0) -> Any:
    header = make_header(FACTORY, round(seconds * SECOND), parent)
    return make_transform(FACTORY, header, child, np.array([x, 0, 0]), turned(degrees))


def message(*transforms: Any) -> Any:
    return FACTORY.make(TRANSFORMS, transforms=list(transforms))


def look_up(frames: FrameTree, frame: str, target: str, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a pose that is known."""
    pose = frames.lookup_pose(frame, target, round(seconds * SECOND))
    assert pose is not None
    return pose


def robot() -> FrameTree:
    """Return a base that drives 2 m/s and turns 90 degrees a second in the map, with a camera 0.5 m before it."""
    frames = FrameTree()
    frames.add(message(link(0, "base", "camera", 0.5)))
    frames.add(message(link(10.0, "map", "base", 1.0)), moving=True)
    frames.add(message(link(11.0, "map", "base", 3.0, 90.0)), moving=True)
    return frames


def test_between_two_stamps_frames_move_and_turn_evenly() -> None:
    position, rotation = look_up(robot(), "camera", "map", 10.5)
    np.testing.assert_allclose(position, [2.0 + 0.5 * np.sqrt(0.5), 0.5 * np.sqrt(0.5), 0], atol=1e-12)
    np.testing.assert_allclose(rotation, turned(45.0), atol=1e-12)
    there, back = look_up(robot(), "map", "camera", 10.5)
    np.testing.assert_allclose(back @ position + there, np.zeros(3), atol=1e-12)


@pytest.mark.parametrize(("seconds", "known"), [(9.9, False), (10.0, True), (11.0, True), (11.1, False)])
def test_nothing_is_known_outside_of_what_was_heard(seconds: float, known: bool) -> None:
    stamp = round(seconds * SECOND)
    assert (robot().lookup_pose("camera", "map", stamp) is not None) == known
    assert robot().is_awaited("camera", "map", stamp) == (seconds > 11)


def test_what_hangs_on_the_same_frame_needs_no_other() -> None:
    frames = robot()
    frames.add(message(link(0, "base", "lidar", -0.5)))
    position, _ = look_up(frames, "camera", "lidar", 99.0)  # no transform of the base is near
    np.testing.assert_allclose(position, [1.0, 0, 0])
    assert not frames.is_awaited("camera", "lidar", 99 * SECOND)


def test_late_transforms_are_put_in_order_and_a_jump_back_begins_anew() -> None:
    frames = robot()
    frames.add(message(link(10.95, "map", "base", 7.0)), moving=True)
    position, _ = look_up(frames, "base", "map", 10.95)
    assert position[0] == pytest.approx(7.0)
    frames.add(message(link(3.0, "map", "base", 0.0)), moving=True)
    assert frames.lookup_pose("base", "map", 11 * SECOND) is None
    assert frames.lookup_pose("base", "map", 3 * SECOND) is not None
    frames.forget_moving()
    assert not frames.is_connected("base", "map")
    assert frames.is_connected("camera", "base")


def test_only_the_last_while_is_kept() -> None:
    frames = FrameTree()
    for seconds in range(100):
        frames.add(message(link(seconds, "map", "base", seconds), link(seconds, "base", f"person{seconds}", 1)), True)
    assert frames.lookup_pose("base", "map", 95 * SECOND) is not None
    assert frames.lookup_pose("base", "map", 50 * SECOND) is None
    assert len(frames._links) < 40  # frames of people who are gone go too


def test_a_frame_that_has_another_parent_is_where_the_new_one_has_it() -> None:
    frames = robot()
    frames.add(message(link(11.5, "odom", "base", 0.0)), moving=True)
    assert not frames.is_connected("camera", "map")
    assert frames.is_connected("camera", "odom")


def test_why_a_pose_is_not_known_is_one_sentence() -> None:
    frames = robot()
    assert frames.describe_missing("camera", "odom", SECOND).startswith("/tf and /tf_static do not connect 'camera'")
    assert "is 1.50 s older" in frames.describe_missing("camera", "map", round(12.5 * SECOND))
    assert "no transform between 'camera' and 'map' as old as" in frames.describe_missing("camera", "map", SECOND)


def test_what_is_no_pose_is_named_and_the_others_are_taken() -> None:
    frames = FrameTree()
    spoiled = link(1, "map", "wheel", float("nan"))
    with pytest.raises(InputError, match="from 'map' to 'wheel' cannot be used: the translation"):
        frames.add(message(spoiled, link(1, "map", "base", 1.0)), moving=True)
    assert frames.is_connected("base", "map")
    assert not frames.is_connected("wheel", "map")
