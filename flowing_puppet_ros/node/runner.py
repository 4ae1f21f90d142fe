# SPDX-License-Identifier: Apache-2.0
"""Starts a node as a program: arguments, one sentence for what cannot work, clean end on an interrupt."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any

from flowing_puppet_ros.errors import PuppetError


def run(name: str, description: str | None, module: str, arguments: list[str] | None = None) -> int:
    """Spin the node `name` until it is interrupted; return the exit status.

    `module` is the module of this package whose `make_node(name)` returns the node; it is imported here, so that the
    absence of ROS is told in a sentence. 0 after an interrupt, 2 when arguments or parameters are unusable or ROS is
    absent (one sentence on stderr).
    """
    try:
        import rclpy
        from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
        from rclpy.utilities import remove_ros_args

        make_node = import_module(module).make_node
    except ImportError as error:
        print(f"{name}: {error}; source a ROS 2 Jazzy, or run `make venv` in the source tree", file=sys.stderr)
        return 2
    given = [name, *(sys.argv[1:] if arguments is None else arguments)]
    try:
        _parser(name, description).parse_args(remove_ros_args(given)[1:])
        rclpy.init(args=given)
        return _spin(name, make_node)
    except (PuppetError, RCLError, UnknownROSArgsError) as error:
        print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    finally:
        rclpy.try_shutdown()


def _parser(name: str, description: str | None) -> argparse.ArgumentParser:
    from flowing_puppet_ros.node.registry import COMPONENTS, NodeSettings

    infos = [*COMPONENTS[name].settings_type.describe(), *NodeSettings.describe()]
    parameters = "\n".join(f"  {info.name} [{info.default}]: {info.description}" for info in infos)
    return argparse.ArgumentParser(
        prog=name,
        description=description,
        epilog=f"parameters (--ros-args -p NAME:=VALUE or --params-file FILE):\n{parameters}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def _spin(name: str, make_node: Callable[[str], Any]) -> int:
    import rclpy
    from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor

    node = make_node(name)
    # The second thread is for an action, which waits for its result while messages come in.
    executor = MultiThreadedExecutor(num_threads=2)
    executor.add_node(node)
    node.get_logger().info("ready")
    try:
        while rclpy.ok():
            try:
                executor.spin_once()
            except (KeyboardInterrupt, ExternalShutdownException):
                break
            except Exception as error:
                # A message of another type under the same topic name must not end the node; a shut-down context does.
                if rclpy.ok():
                    node.get_logger().error(f"{type(error).__name__}: {error}", throttle_duration_sec=5.0)
        return 0
    finally:
        node.destroy_node()
