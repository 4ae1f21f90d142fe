# SPDX-License-Identifier: Apache-2.0
"""A recording of a robot that drives: its /tf is used and copied, and the bodies that it says are not."""

from pathlib import Path

import numpy as np
import pytest
from capsule_man import joints_of  # type: ignore[import-not-found]
from watched_people import stand_at  # type: ignore[import-not-found]

from flowing_puppet_ros.bag.foreign.static_frames import is_of_people
from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.replay.replay import ReplayOptions, replay
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.stream.messages.geometry import make_header, make_transform
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO, IMAGE, TRANSFORMS
from test.stream.components.test_colour_and_depth import FACTORY, SECOND, depth, info
from test.stream.messages.test_frame_tree import link, message

TENTH = SECOND // 10
OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def record(path: Path) -> None:
    """Write two depth images of a man before a camera that drives 1 m/s ahead, and old bodies on /tf."""
    with BagWriter(path) as writer:
        for topic, kind in (("/eye/depth", IMAGE), ("/eye/camera_info", CAMERA_INFO), ("/tf", TRANSFORMS)):
            writer.add_topic(topic, kind)
        for number in range(2):
            stamp = SECOND + number * TENTH
            man = [stand_at(joints_of(), 2.5 - 0.1 * number)]
            writer.write("/eye/camera_info", stamp, info(stamp, 1.0))
            writer.write("/eye/depth", stamp, depth(stamp, man))
            header = make_header(FACTORY, stamp + TENTH // 2, "odom")
            place = np.array([0.1 * (number + 0.5), 0.0, 1.0])
            writer.write("/tf", stamp + TENTH // 2, message(make_transform(FACTORY, header, "eye", place, OPTICAL)))
            old = link(1e-9 * stamp, "eye", "body_old", 1.0), link(1e-9 * stamp, "body_old", "head_old", 1.0)
            writer.write("/tf", stamp + TENTH // 2, message(*old))


@pytest.mark.slow
def test_the_robots_frames_are_used_and_copied_and_old_bodies_are_not(tmp_path: Path) -> None:
    record(tmp_path / "in.mcap")
    settings = {"body_fitter": {"fixed_frame": "odom"}}
    summary = replay(tmp_path / "in.mcap", tmp_path / "out.mcap", ReplayOptions(settings=settings, progress=False))
    # The first image is from before the first transform.
    (warning,) = summary["warnings"]
    assert "no transform between 'eye' and 'odom' as old as" in warning
    counters = summary["counters"]["eye/depth/body_fitter"]
    assert (counters["clouds"], counters["clouds without fixed_frame"]) == (2, 1)
    with open_bag(tmp_path / "out.mcap") as bag:
        written = [record.message for record in bag.messages(["/tf"])]
    children = [item.child_frame_id for each in written for item in each.transforms]
    assert children.count("eye") == 2
    assert not any(child.endswith("_old") for child in children)
    assert any(child.startswith("body_") for child in children)


@pytest.mark.parametrize(
    ("names", "people"),
    [
        ((("eye", "body_ab"), ("body_ab", "head_ab")), True),
        ((("eye", "r1/body_ab"),), True),
        ((("odom", "base"),), False),
        ((("base", "body_link"), ("base", "wheel")), False),
        ((), False),
    ],
)
def test_transforms_of_people_are_told_from_those_of_robots(names: tuple[tuple[str, str], ...], people: bool) -> None:
    assert is_of_people(message(*(link(0, parent, child, 0.0) for parent, child in names))) == people
