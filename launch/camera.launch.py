# SPDX-License-Identifier: Apache-2.0
"""Track the people in a camera's images: `ros2 launch flowing_puppet_ros camera.launch.py`.

The image topic is found if only one is published, else named: `image:=/camera/color/image_raw`.
"""

from __future__ import annotations

from launch import LaunchDescription
from launch_ros.actions import Node

from flowing_puppet_ros.node.launching.actions import Values, describe_launch, humans, make_node
from flowing_puppet_ros.node.launching.topics import COLOUR_IMAGE, find_topic

ARGUMENTS = {
    "image": ("auto", "image topic, raw or its compressed transport; auto: the only colour image that is published"),
    "detections": ("detections", "keypoints of people that another node finds, if one does"),
    "flow": ("false", "compute the optical flow in a node of its own, which publishes it"),
}


def start(values: Values) -> list[Node]:
    """Return the tracker, behind the optical flow if that is asked for."""
    image = find_topic(values["image"], COLOUR_IMAGE)
    inputs = {"image": image, "detections": values["detections"]}
    flow = [make_node(values, "optical_flow", {"image": image})] if values["flow"] == "true" else []
    return [*flow, make_node(values, "puppet_tracker", inputs, **humans(values))]


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and the nodes that follow from them."""
    return describe_launch(ARGUMENTS, start)
