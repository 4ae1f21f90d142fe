# SPDX-License-Identifier: Apache-2.0
"""Track the people of one camera: `ros2 launch flowing_puppet_ros puppet_tracker.launch.py image:=/camera/image_raw`.

The optical flow is computed in the tracker, unless `flow:=true` runs it as a node of its own.
"""

from __future__ import annotations

import sys
from pathlib import Path

try:
    from launch import LaunchDescription
    from launch.actions import DeclareLaunchArgument
    from launch.conditions import IfCondition
    from launch.substitutions import LaunchConfiguration
    from launch_ros.actions import Node
except ImportError as error:
    sys.exit(f"puppet_tracker.launch.py: {error}; launch files need a sourced ROS 2 Jazzy: without it start the nodes")

CONFIG = Path(__file__).resolve().parent.parent / "config"


def generate_launch_description() -> LaunchDescription:
    """Return the tracker of one camera, and the optical flow when it is asked for."""
    arguments = [
        DeclareLaunchArgument("namespace", default_value="", description="namespace of the camera's topics"),
        DeclareLaunchArgument("image", default_value="image", description="image topic"),
        DeclareLaunchArgument(
            "detections", default_value="detections", description="keypoints (PuppetArray), optional"
        ),
        DeclareLaunchArgument("flow", default_value="false", description="run the optical flow as its own node"),
        DeclareLaunchArgument("use_sim_time", default_value="false", description="take the time from /clock"),
        DeclareLaunchArgument(
            "flow_config",
            default_value=str(CONFIG / "optical_flow.yaml"),
            description="parameter file of optical_flow",
        ),
        DeclareLaunchArgument(
            "tracker_config",
            default_value=str(CONFIG / "puppet_tracker.yaml"),
            description="parameter file of puppet_tracker",
        ),
    ]
    common = {"package": "flowing_puppet_ros", "namespace": LaunchConfiguration("namespace"), "output": "screen"}
    clock = {"use_sim_time": LaunchConfiguration("use_sim_time")}
    images = [("image", LaunchConfiguration("image"))]
    flow = Node(
        executable="optical_flow",
        name="optical_flow",
        parameters=[LaunchConfiguration("flow_config"), clock],
        remappings=images,
        condition=IfCondition(LaunchConfiguration("flow")),
        **common,
    )
    tracker = Node(
        executable="puppet_tracker",
        name="puppet_tracker",
        parameters=[LaunchConfiguration("tracker_config"), clock],
        remappings=[*images, ("detections", LaunchConfiguration("detections"))],
        **common,
    )
    return LaunchDescription([*arguments, flow, tracker])
