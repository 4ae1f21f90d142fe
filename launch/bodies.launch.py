# SPDX-License-Identifier: Apache-2.0
"""Fit bodies: `ros2 launch flowing_puppet_ros bodies.launch.py points:=/camera/points`, or from calibrated cameras.

`depth:=/camera/depth/image_rect_raw camera_info:=/camera/depth/camera_info` fits to depth images instead of clouds.
With `cameras:=cam01,cam02,cam03` the images of these namespaces are tracked, one person is cut out of them and carved
as a visual hull, and a body is fitted to the silhouettes; the poses of the cameras are read from /tf_static.
"""

from __future__ import annotations

import sys
from pathlib import Path

try:
    from launch import LaunchContext, LaunchDescription
    from launch.actions import DeclareLaunchArgument, OpaqueFunction
    from launch.substitutions import LaunchConfiguration
    from launch_ros.actions import Node
except ImportError as error:
    sys.exit(f"bodies.launch.py: {error}; launch files need a sourced ROS 2 Jazzy: without it start the nodes")

CONFIG = Path(__file__).resolve().parent.parent / "config"

INPUTS = ("points", "depth", "camera_info", "initial")


def nodes(context: LaunchContext) -> list[Node]:
    """Return the body fitter, and in front of it the trackers and the silhouettes of the named cameras."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ("cameras", "image", *INPUTS)}
    folder = Path(LaunchConfiguration("config").perform(context))
    clock = {"use_sim_time": LaunchConfiguration("use_sim_time")}

    def node(
        name: str, namespace: str = "", remappings: list[tuple[str, str]] | None = None, **parameters: str
    ) -> Node:
        return Node(
            package="flowing_puppet_ros",
            executable=name,
            name=name,
            namespace=namespace,
            output="screen",
            parameters=[str(folder / f"{name}.yaml"), clock, *([parameters] if parameters else [])],
            remappings=remappings or [],
        )

    cameras = [name for name in given["cameras"].split(",") if name]
    if not cameras:
        return [node("body_fitter", remappings=[(name, given[name]) for name in INPUTS])]
    of_cameras = [(f"{camera}/image", f"{camera}/{given['image']}") for camera in cameras]
    return [
        *(node("puppet_tracker", camera, [("image", given["image"])]) for camera in cameras),
        node("visual_hull", remappings=of_cameras, cameras=",".join(cameras)),
        node("body_fitter"),
    ]


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and the nodes that follow from them."""
    arguments = {
        "cameras": ("", "namespaces of calibrated cameras, separated by commas; empty to fit the clouds on `points`"),
        "image": ("image", "image topic in the namespace of each camera"),
        "points": ("points", "cloud topic when there are no cameras"),
        "depth": ("depth", "rectified depth topic (16UC1 mm, 32FC1 m) instead of clouds"),
        "camera_info": ("camera_info", "calibration of the depth camera"),
        "initial": ("initial", "joints that start the fit (BodyArray), optional"),
        "config": (str(CONFIG), "folder of the parameter files"),
        "use_sim_time": ("false", "take the time from /clock"),
    }
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text) for name, (value, text) in arguments.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=nodes)])
