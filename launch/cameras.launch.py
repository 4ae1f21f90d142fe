# SPDX-License-Identifier: Apache-2.0
"""Fit bodies to calibrated cameras: `ros2 launch flowing_puppet_ros cameras.launch.py cameras:=cam01,cam02,cam03`.

People are tracked in the images of every camera, cut out of them and carved as a visual hull, and a body is fitted to
the silhouettes. The poses of the cameras are read from /tf_static. With the namespaces of depth cameras' drivers around
the same people, `depth:=/left,/right`, the body is fitted to silhouettes and depth together.
"""

from __future__ import annotations

from launch import LaunchDescription
from launch_ros.actions import Node

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.node.launching.actions import Values, describe_launch, humans, make_node
from flowing_puppet_ros.node.launching.rgbd_topics import list_depth_topics
from flowing_puppet_ros.node.launching.topics import COLOUR_IMAGE, find_candidates, list_topics

ARGUMENTS = {
    "cameras": ("", "namespaces of the cameras, separated by commas"),
    "image": ("image", "image topic in the namespace of each camera"),
    "camera_info": ("camera_info", "calibration in the namespace of each camera"),
    "depth": ("", "namespaces of depth cameras around the same people, separated by commas, if there are any"),
    "detections": ("detections", "keypoints of people in the namespace of each camera, if another node finds them"),
}


def start(values: Values) -> list[Node]:
    """Return a tracker per camera, the silhouettes' node and the body fitter."""
    cameras = [name for name in values["cameras"].split(",") if name]
    if len(cameras) < 2:
        seen = find_candidates(list_topics(COLOUR_IMAGE), COLOUR_IMAGE)
        raise InputError(
            "name two or more cameras by their namespaces, cameras:=a,b with image:=image_raw for /a/image_raw and"
            f" /b/image_raw; images now: {', '.join(seen) or 'none'}"
        )
    of_cameras = {
        f"{camera}/{topic}": f"{camera}/{values[topic]}" for camera in cameras for topic in ("image", "camera_info")
    }
    inputs = {"image": values["image"], "detections": values["detections"]}
    remapped, rig = list_depth_topics([name for name in values["depth"].split(",") if name])
    return [
        *(make_node(values, "puppet_tracker", inputs, namespace=camera) for camera in cameras),
        make_node(values, "visual_hull", of_cameras, cameras=",".join(cameras)),
        make_node(values, "body_fitter", remapped, **rig, **humans(values)),
    ]


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and the nodes that follow from them."""
    return describe_launch(ARGUMENTS, start)
