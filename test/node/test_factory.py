# SPDX-License-Identifier: Apache-2.0
"""rclpy messages from plain values: types, precision, arrays; the same fields as the bag's messages."""

import array

import numpy as np
import pytest

from flowing_puppet_ros.bag.typestore import typestore
from flowing_puppet_ros.node.factory import RosMessageFactory

pytestmark = pytest.mark.ros


def test_image_data_becomes_a_byte_array_of_the_same_content() -> None:
    pixels = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    message = RosMessageFactory().make("sensor_msgs/msg/Image", height=np.int64(2), encoding="rgb8", data=pixels)
    assert isinstance(message.data, array.array)
    assert message.data.tobytes() == pixels.tobytes()
    assert message.height == 2
    assert message.header.frame_id == ""


def test_numbers_take_the_width_of_their_fields() -> None:
    factory = RosMessageFactory()
    joint = factory.make("flowing_puppet_msgs/msg/PuppetJoint", name="neck", x=0.1, y=np.float64(2), confidence=1)
    assert joint.x == float(np.float32(0.1)) != 0.1
    assert (joint.y, joint.confidence) == (2.0, 1.0)
    assert factory.make("geometry_msgs/msg/Point", x=0.1).x == 0.1
    part = factory.make("flowing_puppet_msgs/msg/PuppetPart", contour=np.array([[1.5, 2.5], [3.5, 4.5]]))
    assert list(part.contour) == [1.5, 2.5, 3.5, 4.5]


def test_fixed_arrays_and_nested_messages() -> None:
    factory = RosMessageFactory()
    info = factory.make("sensor_msgs/msg/CameraInfo", k=np.arange(9).reshape(3, 3), d=[0.1, 0.2])
    assert np.array_equal(info.k, np.arange(9.0))
    assert list(info.d) == [0.1, 0.2]
    triangle = factory.make("shape_msgs/msg/MeshTriangle", vertex_indices=np.array([1, 2, 3], np.int32))
    mesh = factory.make("shape_msgs/msg/Mesh", triangles=[triangle])
    assert list(mesh.triangles[0].vertex_indices) == [1, 2, 3]


def test_an_unknown_field_is_refused() -> None:
    with pytest.raises(TypeError, match="no field 'color'"):
        RosMessageFactory().make("sensor_msgs/msg/Image", color=1)


@pytest.mark.parametrize(
    "name",
    ["flowing_puppet_msgs/msg/BodyArray", "flowing_puppet_msgs/msg/PuppetArray", "hri_msgs/msg/Skeleton2D",
     "flowing_puppet_msgs/msg/BodyMeasurements", "flowing_puppet_msgs/msg/BodyMeasurementsArray",
     "tf2_msgs/msg/TFMessage", "visualization_msgs/msg/MarkerArray", "sensor_msgs/msg/PointCloud2"],
)  # fmt: skip
def test_live_and_bag_messages_have_the_same_fields(name: str) -> None:
    live = RosMessageFactory().make(name).get_fields_and_field_types()
    assert list(live) == [field for field, _ in typestore().fielddefs[name][1]]
