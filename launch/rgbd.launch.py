# SPDX-License-Identifier: Apache-2.0
"""Fit bodies to the people before a camera with colour and depth: `ros2 launch flowing_puppet_ros rgbd.launch.py`.

`camera:=/camera` names the driver's namespace; without it there may be one camera only. With several, as in
`camera:=/left,/right`, one body a person is fitted to the depth images of all of them, which /tf joins. The layouts of
RealSense, Orbbec, ZED, Azure Kinect, HSR and OpenNI drivers are known.
"""

from __future__ import annotations

from launch import LaunchDescription
from launch_ros.actions import Node

from flowing_puppet_ros.node.launching.actions import Values, describe_launch, humans, make_node
from flowing_puppet_ros.node.launching.rgbd_topics import find_rgbd, list_depth_topics

ARGUMENTS = {
    "camera": (
        "",
        "namespace of the camera's driver, or several, separated by commas, around the same people; empty: that of the"
        " only camera with colour and depth",
    ),
    "detections": ("detections", "keypoints of people that another node finds, if one does"),
    "flow": (
        "fast",
        "preset of the optical flow; medium is more accurate and takes as long as a whole camera's bodies",
    ),
}


def start(values: Values) -> list[Node]:
    """Return the tracker of the colour images, and the body fitter that joins its puppets with the depth images.

    Of several cameras, the body fitter of all their depth images.
    """
    cameras = values["camera"].split(",")
    if len(cameras) > 1:
        inputs, rig = list_depth_topics(cameras)
        return [make_node(values, "body_fitter", inputs, **rig, **humans(values))]
    topics = find_rgbd(values["camera"])
    images = {"image": topics.image, "detections": values["detections"]}
    tracker = make_node(values, "puppet_tracker", images, **{"flow.preset": values["flow"]})
    inputs = {"depth": topics.depth, "camera_info": topics.depth_info, "puppets/camera_info": topics.image_info}
    chosen = {"fusion.rectified": True} if topics.rectified else {}
    return [tracker, make_node(values, "body_fitter", inputs, **chosen, **humans(values))]


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and the nodes that follow from them."""
    return describe_launch(ARGUMENTS, start)
