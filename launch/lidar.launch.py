# SPDX-License-Identifier: Apache-2.0
"""Fit bodies to the people in clouds or depth images: `ros2 launch flowing_puppet_ros lidar.launch.py`.

The cloud's topic is found if only one is published, else named: `points:=/velodyne_points`. A depth camera without a
cloud is `depth:=/camera/depth/image_rect_raw camera_info:=/camera/depth/camera_info`.
"""

from __future__ import annotations

from launch import LaunchDescription
from launch_ros.actions import Node

from flowing_puppet_ros.node.launching.actions import Values, describe_launch, humans, make_node
from flowing_puppet_ros.node.launching.topics import CLOUD, find_topic

ARGUMENTS = {
    "points": ("auto", "cloud topic; auto: the only cloud that is published"),
    "depth": ("", "rectified depth topic (16UC1 mm, 32FC1 m) instead of clouds"),
    "camera_info": ("camera_info", "calibration of the depth camera"),
    "initial": ("initial", "joints that start the fit (BodyArray), if another node publishes them"),
    "view": ("auto", "single: one sensor, at the origin of the cloud's frame; full: all sides; auto: found out"),
    "up": (
        "auto",
        "z, y or -y: the axis of the cloud's frame that points up; auto: by /tf_static, or the name of the frame",
    ),
    "fixed_frame": ("", "frame with z up that stands still (odom), where the sensor moves"),
}


def start(values: Values) -> list[Node]:
    """Return the body fitter."""
    inputs = {"initial": values["initial"]}
    if values["depth"]:
        inputs |= {"depth": values["depth"], "camera_info": values["camera_info"]}
    else:
        inputs["points"] = find_topic(values["points"], CLOUD)
    chosen = {name: values[name] for name in ("view", "up", "fixed_frame") if values[name] not in ("", "auto")}
    return [make_node(values, "body_fitter", inputs, **chosen, **humans(values))]


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and the node that follows from them."""
    return describe_launch(ARGUMENTS, start)
