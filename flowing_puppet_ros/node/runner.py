# SPDX-License-Identifier: Apache-2.0
"""Starts a node as a program: arguments, one sentence for what cannot work, clean end on an interrupt."""

from __future__ import annotations

import argparse
import sys
from importlib import import_module
from typing import Any

from threadpoolctl import threadpool_limits

from flowing_puppet_ros.errors import PuppetError


def run(name: str, description: str | None, module: str, arguments: list[str] | None = None) -> int:
    """Spin the node `name` until it is interrupted; return the exit status.

    `module` is the module of this package whose `make_node(name)` returns the node; it is imported here, so that the
    absence of ROS is told in a sentence. 0 after an interrupt, 2 when arguments or parameters are unusable or ROS is
    absent (one sentence on stderr).
    """
    try:
        import rclpy
        from rclpy.exceptions import NameValidationException, ParameterException
        from rclpy.utilities import remove_ros_args

        make_node = import_module(module).make_node
    except ImportError as error:
        print(f"{name}: {error}; source a ROS 2 Jazzy, or run `make venv` in the source tree", file=sys.stderr)
        return 2
    given = [name, *(sys.argv[1:] if arguments is None else arguments)]
    try:
        _parser(name, description).parse_args(remove_ros_args(given)[1:])
        rclpy.init(args=given)
        node = make_node(name)
    except (PuppetError, ParameterException, NameValidationException, RuntimeError) as error:
        # RuntimeError is what rclpy raises for arguments, names and policies that it cannot read.
        print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
        rclpy.try_shutdown()
        return 2
    # Workers of their own use the cores; threads of BLAS beside them would only stand in each other's way.
    threadpool_limits(1)
    _spin(node)
    rclpy.try_shutdown()
    return 0


def _parser(name: str, description: str | None) -> argparse.ArgumentParser:
    from flowing_puppet_ros.stream.components.registry import COMPONENTS, node_settings

    infos = [*COMPONENTS[name].settings_type.describe(), *node_settings(name).describe()]
    parameters = "\n".join(f"  {info.name} [{info.default}]: {info.description}" for info in infos)
    return argparse.ArgumentParser(
        prog=name,
        description=description,
        epilog=f"parameters (--ros-args -p NAME:=VALUE or --params-file FILE):\n{parameters}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def _spin(node: Any) -> None:
    import rclpy
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

    executor = SingleThreadedExecutor()
    executor.add_node(node)
    node.get_logger().info("ready" if node.state == "active" else f"{node.state}: waits for a lifecycle manager")
    while rclpy.ok():
        try:
            executor.spin_once()
        except (KeyboardInterrupt, ExternalShutdownException):
            break
        except Exception as error:
            # A message of another type under the same topic name must not end the node; a shut-down context does.
            if rclpy.ok():
                node.get_logger().error(f"{type(error).__name__}: {error}", throttle_duration_sec=5.0)
    node.destroy_node()
