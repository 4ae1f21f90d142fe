# SPDX-License-Identifier: Apache-2.0
"""The programs that start the nodes: one function each, which runs its node until it is interrupted.

Every error is one sentence, and an interrupt a clean exit. `python -m flowing_puppet_ros.node.main NAME` starts the
node NAME if its program is not installed.
"""

from __future__ import annotations

import argparse
import sys
from importlib import import_module
from typing import Any

from flowing_puppet_ros.errors import PuppetError
from flowing_puppet_ros.process.memory import limit_arenas
from flowing_puppet_ros.process.threads import one_blas_thread, one_opencv_thread
from flowing_puppet_ros.stream.pipeline import SWITCH_INTERVAL_S

SPIN_TIMEOUT_S = 1.0
"""In which an interrupt is noticed: without an end to its waiting, the executor of events notices none."""
_COMPONENT_NODE = "flowing_puppet_ros.node.component_node"


def optical_flow(arguments: list[str] | None = None) -> int:
    """Estimate dense forward and backward optical flow between images."""
    return _run("optical_flow", optical_flow.__doc__, _COMPONENT_NODE, arguments)


def puppet_tracker(arguments: list[str] | None = None) -> int:
    """Track people in images, with or without detections, as flowing puppets."""
    return _run("puppet_tracker", puppet_tracker.__doc__, _COMPONENT_NODE, arguments)


def visual_hull(arguments: list[str] | None = None) -> int:
    """Carve the visual hull of a person from images, part labels and puppets of calibrated cameras."""
    return _run("visual_hull", visual_hull.__doc__, _COMPONENT_NODE, arguments)


def body_fitter(arguments: list[str] | None = None) -> int:
    """Fit bodies to point clouds, depth images or silhouettes; the action fit_body fits one cloud on request."""
    return _run("body_fitter", body_fitter.__doc__, "flowing_puppet_ros.node.body_fitter_node", arguments)


def _run(name: str, description: str | None, module: str, arguments: list[str] | None = None) -> int:
    """Spin the node `name` until it is interrupted; return the exit status.

    The status is 0 after an interrupt, and 2 if arguments or parameters are unusable or ROS is missing (one sentence
    on stderr). `module` is the module of this package whose `make_node(name)` returns the node; it is imported here,
    so that a missing ROS gives that sentence.
    """
    limit_arenas()
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
        _make_parser(name, description).parse_args(remove_ros_args(given)[1:])
        rclpy.init(args=given)
        node = make_node(name)
    except (PuppetError, ParameterException, NameValidationException, RuntimeError) as error:
        # RuntimeError is what rclpy raises for arguments, names and policies that it cannot read.
        print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
        rclpy.try_shutdown()
        return 2
    except KeyboardInterrupt:  # while it starts
        rclpy.try_shutdown()
        return 0
    # While people are fitted on several threads, the one that receives messages waits for its turn.
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    # The node's own workers use the cores; threads of BLAS and OpenCV beside them would only slow them down.
    with one_blas_thread(), one_opencv_thread():
        _spin(node)
    rclpy.try_shutdown()
    return 0


def _make_parser(name: str, description: str | None) -> argparse.ArgumentParser:
    from flowing_puppet_ros.stream.components.registry import published

    infos = published(name)
    parameters = "\n".join(f"  {info.name} [{info.default}]: {info.description}" for info in infos)
    return argparse.ArgumentParser(
        prog=name,
        description=description,
        epilog=f"parameters (--ros-args -p NAME:=VALUE or --params-file FILE):\n{parameters}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def _make_executor() -> Any:
    """Return rclpy's executor that is told of messages, or the older one where rclpy has no other.

    The older one prepares all subscriptions anew for every message: 0.12 of a core instead of 0.05 for depth, its
    calibration and puppets at 30 Hz.
    """
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor()
    return EventsExecutor()


def _spin(node: Any) -> None:
    import rclpy
    from rclpy.executors import ExternalShutdownException

    executor = _make_executor()
    executor.add_node(node)
    node.get_logger().info("ready" if node.state == "active" else f"{node.state}: waits for a lifecycle manager")
    while rclpy.ok():
        try:
            executor.spin_once(timeout_sec=SPIN_TIMEOUT_S)
        except (KeyboardInterrupt, ExternalShutdownException):
            break
        except Exception as error:
            # A message of another type under the same topic name must not end the node; a shut-down context does.
            if rclpy.ok():
                node.get_logger().error(f"{type(error).__name__}: {error}", throttle_duration_sec=5.0)
    node.destroy_node()


if __name__ == "__main__":
    sys.exit(globals()[sys.argv[1]](sys.argv[2:]))
