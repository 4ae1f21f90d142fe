# SPDX-License-Identifier: Apache-2.0
"""Run the nodes' algorithms over a recording: `ros2 launch flowing_puppet_ros replay.launch.py bag:=FOLDER`.

No message is lost, and the same recording gives the same bytes; `ros2 bag play` shows the result.
"""

from __future__ import annotations

import sys

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

ARGUMENTS = {
    "bag": ("", "the recording: an .mcap file, a rosbag2 folder or a ROS 1 .bag"),
    "out": ("people.mcap", "the recording of puppets and bodies to write"),
    "report": ("people.html", "the page about it to write, for any browser"),
}


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and the program."""
    value = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text) if default
        else DeclareLaunchArgument(name, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]  # fmt: skip
    program = [sys.executable, "-m", "flowing_puppet_ros", "replay", value["bag"]]
    run = ExecuteProcess(cmd=[*program, "--out", value["out"], "--report", value["report"]], output="screen")
    return LaunchDescription([*declared, run])
