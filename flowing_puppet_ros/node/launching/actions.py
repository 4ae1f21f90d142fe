# SPDX-License-Identifier: Apache-2.0
"""Launch descriptions of nodes: the arguments that all have, and the nodes with their parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

PACKAGE = "flowing_puppet_ros"
type Arguments = Mapping[str, tuple[str, str]]
"""Arguments with their defaults and descriptions."""
type Values = Mapping[str, str]
"""What the arguments are in this launch."""

COMMON: Arguments = {
    "namespace": ("", "namespace of the nodes and of their topics"),
    "params_file": ("", "file of parameters that differ from those in the package's config folder"),
    "humans": ("false", "publish the topics of REP-155 (ROS4HRI), under /humans"),
    "log_level": ("info", "debug, info, warn, error or fatal"),
    "use_sim_time": ("false", "take the time from /clock"),
}


def describe_launch(arguments: Arguments, start: Callable[[Values], Sequence[Any]]) -> LaunchDescription:
    """Return the description that declares `arguments`, and COMMON, and runs what `start` makes of their values."""
    every = {**arguments, **COMMON}
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in every.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=partial(_start, start, tuple(every)))])


def make_node(values: Values, name: str, remappings: Mapping[str, str], namespace: str = "", **parameters: Any) -> Node:
    """Return the action that starts a node.

    Args:
        values: of the arguments.
        name: of the node and of its program.
        remappings: topics by the node's own name for them.
        namespace: below the argument `namespace`.
        parameters: that the launch file decides itself.
    """
    config = Path(get_package_share_directory(PACKAGE)) / "config" / f"{name}.yaml"
    return Node(
        package=PACKAGE,
        executable=name,
        name=name,
        namespace="/".join(filter(None, (values["namespace"], namespace))),
        output="screen",
        # Later ones win.
        parameters=[
            str(config),
            *filter(None, [values["params_file"]]),
            {"use_sim_time": values["use_sim_time"] == "true", **parameters},
        ],
        remappings=[(own, topic) for own, topic in remappings.items() if own != topic],
        arguments=["--ros-args", "--log-level", values["log_level"]],
    )


def humans(values: Values) -> dict[str, bool]:
    """Return the parameters of a node that can publish the topics of REP-155."""
    return {"ros4hri.publish": True} if values["humans"] == "true" else {}


def _start(start: Callable[[Values], Sequence[Any]], names: Sequence[str], context: LaunchContext) -> Sequence[Any]:
    return start({name: LaunchConfiguration(name).perform(context) for name in names})
