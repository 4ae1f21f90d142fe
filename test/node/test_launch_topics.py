# SPDX-License-Identifier: Apache-2.0
"""`auto` finds the one topic that it can only mean, and lists the candidates otherwise."""

import re

import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.node.launching.rgbd_topics import choose_rgbd
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


INFO = "sensor_msgs/msg/CameraInfo"
AZURE = {
    "/rgb/image_raw": [IMAGE], "/rgb/camera_info": [INFO], "/depth/image_raw": [IMAGE], "/depth/camera_info": [INFO],
    "/depth_to_rgb/image_raw": [IMAGE], "/depth_to_rgb/camera_info": [INFO], "/ir/image_raw": [IMAGE],
}  # fmt: skip
ZED = {
    "/zed/zed_node/rgb/color/rect/image": [IMAGE], "/zed/zed_node/rgb/color/rect/camera_info": [INFO],
    "/zed/zed_node/left/color/rect/image": [IMAGE], "/zed/zed_node/depth/depth_registered": [IMAGE],
    "/zed/zed_node/depth/camera_info": [INFO],
}  # fmt: skip
HSR = {
    "/hsrb/head_rgbd_sensor/rgb/image_raw/compressed": [PACKED], "/hsrb/head_rgbd_sensor/rgb/camera_info": [INFO],
    "/hsrb/head_rgbd_sensor/depth_registered/image/compressedDepth": [PACKED], "/hsrb/hand_camera/image_raw": [IMAGE],
}  # fmt: skip


@pytest.mark.parametrize(
    ("topics", "camera", "found"),
    [
        (REALSENSE | {"/camera/camera/color/camera_info": [INFO]}, "/camera",
         ("color/image_raw", "color/camera_info", "aligned_depth_to_color/image_raw", "color/camera_info")),
        (ORBBEC | {"/camera/color/camera_info": [INFO], "/camera/depth/camera_info": [INFO]}, "camera",
         ("color/image_raw", "color/camera_info", "depth/image_raw", "depth/camera_info")),
        (AZURE, "", ("rgb/image_raw", "rgb/camera_info", "depth_to_rgb/image_raw", "depth_to_rgb/camera_info")),
        (ZED, "/zed", ("rgb/color/rect/image", "rgb/color/rect/camera_info", "depth/depth_registered",
                       "depth/camera_info")),
        (HSR, "/hsrb", ("rgb/image_raw", "rgb/camera_info", "depth_registered/image", "rgb/camera_info")),
    ],
)  # fmt: skip
def test_the_layouts_of_drivers_are_known(topics: dict[str, list[str]], camera: str, found: tuple[str, ...]) -> None:
    chosen = choose_rgbd(topics, camera)
    names = (chosen.image, chosen.image_info, chosen.depth, chosen.depth_info)
    base = chosen.image.removesuffix(found[0])
    assert names == tuple(base + name for name in found)
    assert chosen.rectified == ("rect" in found[0])


def test_a_camera_that_is_not_plain_is_one_sentence() -> None:
    two = {f"/{name}/color/image_raw": [IMAGE] for name in ("left", "right")}
    with pytest.raises(InputError, match="colour images could be /left/color/image_raw, /right/color/image_raw"):
        choose_rgbd(two, "")
    with pytest.raises(InputError, match=r"no depth images below /left/ .* are /left/color/image_raw;"):
        choose_rgbd(two, "left")
    with pytest.raises(InputError, match="no colour images below /c/ .* are none;"):
        choose_rgbd({}, "/c")
    with pytest.raises(InputError, match="nobody publishes /camera/color/camera_info"):
        choose_rgbd(ORBBEC, "/camera")


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
