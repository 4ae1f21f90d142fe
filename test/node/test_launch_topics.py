# SPDX-License-Identifier: Apache-2.0
"""`auto` finds the one topic that it can only mean, and lists the candidates otherwise."""

import re

import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.node.launching.topics import CLOUD, COLOUR_IMAGE, choose_topic, find_topic, list_topics

IMAGE, PACKED, CLOUDS = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/PointCloud2"
REALSENSE = {
    "/camera/camera/color/image_raw": [IMAGE],
    "/camera/camera/color/image_raw/compressed": [PACKED],
    "/camera/camera/depth/image_rect_raw": [IMAGE],
    "/camera/camera/depth/image_rect_raw/compressedDepth": [PACKED],
    "/camera/camera/aligned_depth_to_color/image_raw": [IMAGE],
    "/camera/camera/infra1/image_rect_raw": [IMAGE],
    "/camera/camera/depth/color/points": [CLOUDS],
    "/tf": ["tf2_msgs/msg/TFMessage"],
}
ORBBEC = {
    "/camera/color/image_raw": [IMAGE],
    "/camera/color/image_raw/theora": ["theora_image_transport/msg/Packet"],
    "/camera/depth/image_raw": [IMAGE],
    "/camera/ir/image_raw": [IMAGE],
    "/camera/left_ir/image_raw": [IMAGE],
    "/camera/depth/points": [CLOUDS],
}


@pytest.mark.parametrize(
    ("topics", "image", "cloud"),
    [
        (REALSENSE, "/camera/camera/color/image_raw", "/camera/camera/depth/color/points"),
        (ORBBEC, "/camera/color/image_raw", "/camera/depth/points"),
        ({"/image_raw/compressed": [PACKED], "/ouster/points": [CLOUDS]}, "/image_raw", "/ouster/points"),
        ({"/image_raw": [IMAGE], "/overlay": [IMAGE], "/part_labels": [IMAGE], "/body_vertices": [CLOUDS],
          "/velodyne_points": [CLOUDS]}, "/image_raw", "/velodyne_points"),
    ],
)  # fmt: skip
def test_the_only_one_is_taken(topics: dict[str, list[str]], image: str, cloud: str) -> None:
    assert choose_topic(topics, COLOUR_IMAGE) == image
    assert choose_topic(topics, CLOUD) == cloud


def test_several_are_listed_and_none_is_said() -> None:
    zed = {"/zed/left/image_rect_color": [IMAGE], "/zed/right/image_rect_color": [IMAGE], "/zed/stereo": [IMAGE]}
    listed = "/zed/left/image_rect_color, /zed/right/image_rect_color, /zed/stereo"
    with pytest.raises(InputError, match=re.escape(f"image could be {listed}; choose with image:=TOPIC")):
        choose_topic(zed, COLOUR_IMAGE)
    with pytest.raises(InputError, match="nobody publishes a PointCloud2 for points"):
        choose_topic(zed, CLOUD)


def test_what_is_named_is_not_looked_for() -> None:
    assert find_topic("/anything", CLOUD) == "/anything"


@pytest.mark.ros
@pytest.mark.slow
def test_a_running_graph_is_read() -> None:
    import rclpy
    from sensor_msgs.msg import PointCloud2

    context = rclpy.context.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("a_driver", context=context)
    try:
        publisher = node.create_publisher(PointCloud2, "/a_lidar/points", 1)
        node.create_subscription(PointCloud2, "/only/subscribed", lambda message: None, 1)
        assert list_topics(CLOUD)["/a_lidar/points"] == [CLOUDS]
        assert find_topic("auto", CLOUD) == "/a_lidar/points"
        node.destroy_publisher(publisher)
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)
