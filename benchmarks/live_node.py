# SPDX-License-Identifier: Apache-2.0
"""Feed a node prepared images or clouds over DDS and measure its results: rate, latency, lock-on, memory.

`python -m benchmarks.live_node NODE INPUT.npz --rate HZ --seconds S [-- ROS arguments of the node]` starts
the node as its own process, publishes the array `images` (N, H, W, 3) or `clouds` (N, P, 3) of the file back and forth,
or over and over where the file has a `round`, stamped with the current time, and prints one JSON object. Input is
reliable, because a best-effort subscriber of Fast DDS in its default configuration misses a quarter of images of a
megabyte.
"""

from __future__ import annotations

import argparse
import json
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile

from flowing_puppet_ros.node.factory import RosMessageFactory, message_type
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import header_ns, make_header
from flowing_puppet_ros.stream.messages.images import make_image
from flowing_puppet_ros.stream.messages.message_types import BODIES, IMAGE, POINT_CLOUD, PUPPETS

STREAMS = {
    "puppet_tracker": ("images", "image", IMAGE, "puppets", PUPPETS),
    "body_fitter": ("clouds", "points", POINT_CLOUD, "bodies", BODIES),
}
"""Node -> array of the input file, input topic and type, output topic and type."""
NAMESPACE = "/measured"
START_TIMEOUT_S = 300.0
"""Maximum time for a node to start: the first time after an installation it compiles its kernels."""
SETTLING_S = 60.0
"""Time after which memory should no longer grow."""


class Feeder(Node):
    """Publishes the input and records the results."""

    def __init__(self, name: str, arrays: Any) -> None:
        """Make the messages; only their stamps change later."""
        super().__init__("measure", namespace=NAMESPACE)
        array, topic, kind, output, output_kind = STREAMS[name]
        factory = RosMessageFactory()
        header = make_header(factory, 0, "sensor")
        once = [
            make_image(factory, header, item, "rgb8") if array == "images" else make_cloud(factory, header, item)
            for item in arrays[array]
        ]
        self.messages = once if "round" in arrays else [*once, *once[-2:0:-1]]
        self.feed = self.create_publisher(message_type(kind), topic, QoSProfile(depth=2))
        self.people = output
        self.sent = 0
        self.arrivals: list[tuple[float, float, int]] = []
        """Arrival (s, monotonic), latency (s) and number of people of every result."""
        self.create_subscription(message_type(output_kind), output, self._record_result, QoSProfile(depth=50))

    def send(self) -> None:
        """Publish the next message, stamped now."""
        message = self.messages[self.sent % len(self.messages)]
        message.header.stamp = self.get_clock().now().to_msg()
        self.feed.publish(message)
        self.sent += 1

    def _record_result(self, message: Any) -> None:
        latency = (self.get_clock().now().nanoseconds - header_ns(message.header)) * 1e-9
        self.arrivals.append((time.monotonic(), latency, len(getattr(message, self.people))))


def measure(
    name: str, arrays: Any, rate: float, seconds: float, people: int, ros_arguments: list[str]
) -> dict[str, Any]:
    """Run the node on `seconds` of input that shows so many people; RuntimeError if it does not start."""
    reliable = f"qos_overrides.{NAMESPACE}/{STREAMS[name][1]}.subscription.reliability:=reliable"
    command = [sys.executable, "-m", "flowing_puppet_ros.node.main", name, "--ros-args"]
    command += ["-r", f"__ns:={NAMESPACE}", "-p", reliable]
    feeder = Feeder(name, arrays)
    executor = SingleThreadedExecutor()
    executor.add_node(feeder)
    with subprocess.Popen([*command, *ros_arguments], stdin=subprocess.DEVNULL) as process:
        try:
            ready = _wait_for_node(feeder, executor, process)
            start = {"node": name, "people": people, "input_hz": rate, "ready_s": round(ready, 2)}
            return start | _feed(feeder, executor, process.pid, rate, seconds, people)
        finally:
            process.send_signal(signal.SIGINT)


def _wait_for_node(feeder: Feeder, executor: SingleThreadedExecutor, process: subprocess.Popen[bytes]) -> float:
    """Return the seconds until the node takes input."""
    begin = time.monotonic()
    until = begin + START_TIMEOUT_S
    while not feeder.feed.get_subscription_count():
        if process.poll() is not None or time.monotonic() > until:
            raise RuntimeError("the node did not start")
        executor.spin_once(timeout_sec=0.05)
    return time.monotonic() - begin


def _feed(
    feeder: Feeder, executor: SingleThreadedExecutor, pid: int, rate: float, seconds: float, wanted: int
) -> dict[str, Any]:
    memory: list[tuple[float, float]] = []
    start = time.monotonic()

    def send() -> None:
        feeder.send()
        if not memory or time.monotonic() > memory[-1][0] + 1.0:
            memory.append((time.monotonic(), _resident_megabytes(pid)))

    send_evenly(send, executor, rate, seconds)
    found = [arrival for arrival, _, people in feeder.arrivals if people >= wanted]
    lock_on = found[0] if found else float("inf")
    steady = [(arrival, latency) for arrival, latency, _ in feeder.arrivals if arrival > lock_on]
    latencies = sorted(1000 * latency for _, latency in steady)
    settled = [megabytes for at, megabytes in memory if at >= start + min(SETTLING_S, seconds / 2)]
    return {
        "sent": feeder.sent,
        "results": len(feeder.arrivals),
        "with_people": len(found),
        "lock_on_s": round(lock_on - start, 2) if found else None,
        "output_hz": round(len(steady) / (start + seconds - lock_on), 2) if found else 0.0,
        "latency_median_ms": round(statistics.median(latencies), 1) if latencies else None,
        "latency_p95_ms": round(latencies[int(0.95 * (len(latencies) - 1))], 1) if latencies else None,
        "memory_mb": round(memory[-1][1], 1),
        "growth_mb": round(settled[-1] - settled[0], 1),
    }


def send_evenly(send: Callable[[], None], executor: SingleThreadedExecutor, rate: float, seconds: float) -> None:
    """Call `send` at a rate for so long, and take in what comes back meanwhile."""
    start, sent = time.monotonic(), 0
    while (now := time.monotonic()) < start + seconds:
        due = start + sent / rate
        if now >= due:
            send()
            sent += 1
        executor.spin_once(timeout_sec=max(0.0, min(due - now, 0.05)))


def _resident_megabytes(pid: int) -> float:
    """Return the resident memory of a process in megabytes."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS"))


def print_figures(name: str, source: Path, measure_with: Callable[[Any], dict[str, Any]]) -> int:
    """Print what is measured with the arrays of a file, in ROS, as JSON; return the exit status."""
    rclpy.init(args=[])
    try:
        with np.load(source) as arrays:
            print(json.dumps(measure_with(arrays)))
    except (RuntimeError, KeyboardInterrupt, ExternalShutdownException) as error:
        print(f"measure {name}: {error or 'interrupted'}", file=sys.stderr)
        return 1
    finally:
        rclpy.try_shutdown()
    return 0


def main() -> int:
    """Measure according to the command line and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("node", choices=STREAMS)
    parser.add_argument("input", type=Path)
    parser.add_argument("--rate", type=float, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--people", type=int, default=1, help="in the input; results with fewer are not counted")
    split = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    given, ros_arguments = parser.parse_args(sys.argv[1:split]), sys.argv[split + 1 :]
    return print_figures(
        given.node,
        given.input,
        lambda arrays: measure(given.node, arrays, given.rate, given.seconds, given.people, ros_arguments),
    )


if __name__ == "__main__":
    sys.exit(main())
