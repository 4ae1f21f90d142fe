# SPDX-License-Identifier: Apache-2.0
"""Feed puppet_tracker and body_fitter colour and depth of two people over DDS and measure the bodies.

`python -m benchmarks.live_rgbd INPUT.npz --rate HZ --seconds S` starts both nodes as processes of their own, publishes
`colour` (N, H, W, 3), `depth` (N, H, W) mm and, where the file has them, `keypoints` (N, P, 12, 3) as detections, back
and forth, stamped with the current time, and prints one JSON object. For the first second, which is not measured, the
room is empty (`empty_colour` (H, W, 3), `empty_depth` (H, W) mm).
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile

from benchmarks.live_node import NAMESPACE, START_TIMEOUT_S, print_figures, send_evenly
from flowing_puppet_ros.evaluate.rgbd.keypoints import LIMB_JOINTS
from flowing_puppet_ros.node.factory import RosMessageFactory, message_type
from flowing_puppet_ros.stream.messages.geometry import header_ns, make_camera_info, make_header
from flowing_puppet_ros.stream.messages.images import make_image
from flowing_puppet_ros.stream.messages.message_types import BODIES, CAMERA_INFO, IMAGE, PUPPETS

FRAME = "camera_optical_frame"
EMPTY_S = 1.0
NODES = {
    "puppet_tracker": ("image", "detections"),
    "body_fitter": ("depth", "camera_info"),
}
"""Node -> inputs of which nothing should be lost."""


class RgbdFeeder(Node):
    """Publishes colour and depth and records the bodies."""

    def __init__(self, arrays: Any) -> None:
        """Make the messages; only their stamps change later."""
        super().__init__("measure", namespace=NAMESPACE)
        factory = RosMessageFactory()
        header = make_header(factory, 0, FRAME)
        height, width = arrays["depth"].shape[1:]
        info = make_camera_info(factory, header, (width, height), arrays["matrix"], np.zeros(5))
        keypoints = arrays.get("keypoints", [None] * len(arrays["depth"]))

        def make_moment(colour: np.ndarray, depth: np.ndarray, people: np.ndarray | None) -> dict[str, Any]:
            messages = {
                "camera_info": info,
                "image": make_image(factory, header, colour, "rgb8"),
                "depth": make_image(factory, header, depth, "16UC1"),
            }
            return messages if people is None else messages | {"detections": make_detections(factory, header, people)}

        once = [make_moment(*each) for each in zip(arrays["colour"], arrays["depth"], keypoints, strict=True)]
        self._moments = [*once, *once[-2:0:-1]]
        nobody = None if keypoints[0] is None else keypoints[0][:0]
        self._empty = make_moment(arrays["empty_colour"], arrays["empty_depth"], nobody)
        kinds = {"camera_info": CAMERA_INFO, "image": IMAGE, "depth": IMAGE, "detections": PUPPETS}
        self.feeds = {
            name: self.create_publisher(message_type(kinds[name]), name, QoSProfile(depth=4)) for name in once[0]
        }
        self.people = len(arrays["keypoints"][0]) if "keypoints" in arrays else 0
        self.sent = 0
        self.results: dict[str, list[tuple[float, float, int]]] = {"bodies": [], "puppets": []}
        """Arrival (s, monotonic), latency (s) and number of people of every result."""
        for name, kind in (("bodies", BODIES), ("puppets", PUPPETS)):
            self.create_subscription(
                message_type(kind), name, lambda message, name=name: self._record(name, message), QoSProfile(depth=50)
            )

    def send(self, with_people: bool) -> None:
        """Publish the next moment, or the empty room, stamped now."""
        stamp = self.get_clock().now().to_msg()
        moment = self._moments[self.sent % len(self._moments)] if with_people else self._empty
        for name, message in moment.items():
            message.header.stamp = stamp
            self.feeds[name].publish(message)
        self.sent += with_people

    def _record(self, name: str, message: Any) -> None:
        latency = (self.get_clock().now().nanoseconds - header_ns(message.header)) * 1e-9
        self.results[name].append((time.monotonic(), latency, len(getattr(message, name))))


def make_detections(factory: RosMessageFactory, header: Any, people: np.ndarray) -> Any:
    """Return a PuppetArray of the keypoints (P, 12, 3) of people: x, y and confidence."""
    puppets = []
    for person in people:
        joints = [
            factory.make("flowing_puppet_msgs/msg/PuppetJoint", name=name, x=x, y=y, confidence=sure)
            for name, (x, y, sure) in zip(LIMB_JOINTS, person, strict=True)
            if np.isfinite(x)
        ]
        puppets.append(factory.make("flowing_puppet_msgs/msg/Puppet", confidence=0.9, joints=joints))
    return factory.make(PUPPETS, header=header, puppets=puppets)


@contextmanager
def running_node(name: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a node as a process of its own; reliable inputs, as `live_node` says why."""
    command = [sys.executable, "-m", "flowing_puppet_ros.node.main", name, "--ros-args", "-r", f"__ns:={NAMESPACE}"]
    for topic in NODES[name]:
        command += ["-p", f"qos_overrides.{NAMESPACE}/{topic}.subscription.reliability:=reliable"]
    if name == "puppet_tracker":
        command += ["-p", "flow.preset:=fast"]  # as rgbd.launch.py starts it
    if name == "body_fitter":
        command += ["-r", f"puppets/camera_info:={NAMESPACE}/camera_info"]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL) as process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)


def measure(arrays: Any, rate: float, seconds: float) -> dict[str, Any]:
    """Run both nodes on `seconds` of input and return the figures; RuntimeError if they do not start."""
    feeder = RgbdFeeder(arrays)
    executor = SingleThreadedExecutor()
    executor.add_node(feeder)
    with ExitStack() as stack:
        processes = [stack.enter_context(running_node(name)) for name in NODES]
        until = time.monotonic() + START_TIMEOUT_S
        while not all(feeder.feeds[name].get_subscription_count() for name in ("image", "depth")):
            if any(process.poll() is not None for process in processes) or time.monotonic() > until:
                raise RuntimeError("a node did not start")
            executor.spin_once(timeout_sec=0.1)
        time.sleep(1.0)  # until everybody has found everybody
        send_evenly(partial(feeder.send, with_people=False), executor, rate, EMPTY_S)
        start = time.monotonic()
        send_evenly(partial(feeder.send, with_people=True), executor, rate, seconds)
        return summarise(feeder, start, seconds) | {"input_hz": rate}


def summarise(feeder: RgbdFeeder, start: float, seconds: float) -> dict[str, Any]:
    """Return the figures of what came."""
    bodies = [result for result in feeder.results["bodies"] if result[0] > start]
    first = next((arrival for arrival, _, people in bodies if people), None)
    everybody = next((arrival for arrival, _, people in bodies if people >= max(feeder.people, 2)), None)
    steady = [latency for arrival, latency, _ in bodies if first is not None and arrival > first + 1.0]
    lasted = start + seconds - first - 1.0 if first is not None else 0.0
    return {
        "sent": feeder.sent,
        "puppets_hz": round(sum(arrival > start for arrival, _, _ in feeder.results["puppets"]) / seconds, 2),
        "lock_on_s": None if first is None else round(first - start, 2),
        "everybody_s": None if everybody is None else round(everybody - start, 2),
        "output_hz": round(len(steady) / lasted, 2) if lasted > 0 else 0.0,
        "latency_median_ms": round(1000 * float(np.median(steady)), 1) if steady else None,
        "latency_p95_ms": round(1000 * float(np.quantile(steady, 0.95)), 1) if steady else None,
    }


def main() -> int:
    """Measure according to the command line and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("input", type=Path)
    parser.add_argument("--rate", type=float, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    given = parser.parse_args()
    return print_figures(
        "colour and depth", given.input, lambda arrays: measure(dict(arrays), given.rate, given.seconds)
    )


if __name__ == "__main__":
    sys.exit(main())
