# SPDX-License-Identifier: Apache-2.0
"""The factory of bag messages, and the types it knows."""

import numpy as np
import pytest

from flowing_puppet_ros.bag.typestore import BagMessageFactory, typestore

FACTORY = BagMessageFactory()


def test_fields_without_a_value_are_zero_and_serialise() -> None:
    for name in (
        "sensor_msgs/msg/CameraInfo",
        "visualization_msgs/msg/MarkerArray",
        "visualization_msgs/msg/Marker",
        "flowing_puppet_msgs/msg/BodyArray",
        "tf2_msgs/msg/TFMessage",
        "hri_msgs/msg/Skeleton2D",
    ):
        message = FACTORY.make(name)
        again = typestore().deserialize_cdr(typestore().serialize_cdr(message, name), name)
        assert typestore().serialize_cdr(again, name) == typestore().serialize_cdr(message, name)
    assert FACTORY.make("sensor_msgs/msg/CameraInfo").k.tolist() == [0.0] * 9


def test_numbers_are_what_the_wire_carries() -> None:
    joint = FACTORY.make("flowing_puppet_msgs/msg/PuppetJoint", name="nose", x=0.1, y=np.float64(2), confidence=1)
    assert joint.x == float(np.float32(0.1)) != 0.1
    part = FACTORY.make("flowing_puppet_msgs/msg/PuppetPart", contour=np.array([[1.0, 2], [3, 4]]))
    assert part.contour.dtype == np.float32
    assert part.contour.tolist() == [1, 2, 3, 4]


def test_unknown_fields_are_refused() -> None:
    with pytest.raises(TypeError, match="has no field 'colour'"):
        FACTORY.make("std_msgs/msg/Header", colour="red")
