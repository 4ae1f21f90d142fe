# SPDX-License-Identifier: Apache-2.0
"""Stamps, rotations and the tree of static frames."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages import geometry

FACTORY = BagMessageFactory()


@given(st.integers(0, 2**31 * 10**9 - 1))
def test_stamps_come_back_to_the_nanosecond(nanoseconds: Any) -> None:
    assert geometry.header_ns(geometry.make_header(FACTORY, nanoseconds, "f")) == nanoseconds


@given(st.integers(0, 10**6))
def test_quaternions_agree_with_scipy(seed: Any) -> None:
    rotation = Rotation.from_quat(np.random.default_rng(seed).normal(size=4))
    expected = rotation.as_quat(canonical=True)
    message = geometry.make_quaternion(FACTORY, rotation.as_matrix())
    found = np.array([message.x, message.y, message.z, message.w])
    assert found[3] >= 0
    assert min(np.abs(found - expected).max(), np.abs(found + expected).max()) < 1e-9
    np.testing.assert_allclose(geometry.rotation_matrix(3 * expected), rotation.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("q", [(0, 0, 0, 0), (float("nan"), 0, 0, 1)])
def test_what_is_no_quaternion_is_refused(q: Any) -> None:
    with pytest.raises(InputError, match="is not a quaternion"):
        geometry.rotation_matrix(q)


def chain(links: Any) -> Any:
    """A TFMessage of parent, child, position, rotation."""
    return FACTORY.make(
        "tf2_msgs/msg/TFMessage",
        transforms=[
            geometry.make_transform(FACTORY, geometry.make_header(FACTORY, 0, parent), child, position, rotation)
            for parent, child, position, rotation in links
        ],
    )


def test_frames_multiply_along_the_tree() -> None:
    rng = np.random.default_rng(2)
    turns = Rotation.from_quat(rng.normal(size=(3, 4))).as_matrix()
    places = rng.normal(size=(3, 3))
    tree = geometry.FrameTree()
    tree.add(chain([("rig", "left", places[1], turns[1]), ("rig", "/right", places[2], turns[2])]))
    tree.add(chain([("world", "rig", places[0], turns[0])]))
    assert tree.find_root("left") == "world"
    point = rng.normal(size=3)
    in_world = turns[0] @ (turns[1] @ point + places[1]) + places[0]
    in_world_frame = tree.lookup_pose("left", "world")
    assert in_world_frame is not None
    position, rotation = in_world_frame
    np.testing.assert_allclose(rotation @ point + position, in_world)
    in_right_frame = tree.lookup_pose("left", "right")
    assert in_right_frame is not None
    position, rotation = in_right_frame
    in_right = turns[2].T @ (turns[0].T @ (in_world - places[0]) - places[2])
    np.testing.assert_allclose(rotation @ point + position, in_right)
    assert tree.lookup_pose("left", "moon") is None


def test_a_loop_of_frames_is_refused() -> None:
    tree = geometry.FrameTree()
    tree.add(chain([("a", "b", np.zeros(3), np.eye(3)), ("b", "a", np.zeros(3), np.eye(3))]))
    with pytest.raises(InputError, match="loop"):
        tree.find_root("a")
