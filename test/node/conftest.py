# SPDX-License-Identifier: Apache-2.0
"""Nodes as processes of their own, and a ROS node of the test's own to talk with them."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

PATIENCE = 240.0
"""Seconds after which a test gives up on a message; a busy machine may have to compile the kernels first."""
QUICK_FIT = {
    "fitter.particles": 4, "fitter.iterations": 1, "fitter.gauss_newton_steps": 1, "fitter.restarts": 0,
    "fitter.max_limb_repairs": 0, "fitter.nonrigid": "false", "fitter.levenberg_steps": 0,
}  # fmt: skip
"""Parameters of a body_fitter for tests in which it does not matter how well a body fits."""


def arguments(parameters: Mapping[str, object]) -> list[str]:
    """Return ROS arguments that set parameters."""
    return [part for name, value in parameters.items() for part in ("-p", f"{name}:={value}")]


class Peer(Node):
    """The test's own node."""

    def __init__(self) -> None:
        """Join the graph."""
        super().__init__("peer")
        self._own_executor = SingleThreadedExecutor()
        self._own_executor.add_node(self)

    def spin_until(self, condition: Callable[[], object], what: str) -> None:
        """Take messages until `condition` holds; fail when it does not within PATIENCE."""
        until = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < until, f"waited in vain for {what}"
            self._own_executor.spin_once(timeout_sec=0.05)

    def spin_for(self, seconds: float) -> None:
        """Take messages for a while."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self._own_executor.spin_once(timeout_sec=0.05)


@pytest.fixture
def peer() -> Iterator[Peer]:
    """Return a node of the test's own."""
    rclpy.init()
    made = Peer()
    yield made
    made.destroy_node()
    rclpy.try_shutdown()


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Path]]:
    """Return a function that starts an installed node and returns the file of its log; all must end cleanly."""
    with running_nodes(tmp_path) as run:
        yield run


@contextmanager
def running_nodes(folder: Path) -> Iterator[Callable[..., Path]]:
    """Yield a function that starts an installed node with its log in `folder`; all must end cleanly."""
    running: list[tuple[str, subprocess.Popen[bytes], Path]] = []

    def run(name: str, *ros_arguments: str) -> Path:
        log = folder / f"{len(running)}_{name}.log"
        command = [str(Path(sys.executable).with_name(name)), "--ros-args", *ros_arguments]
        with log.open("wb") as output:
            process = subprocess.Popen(command, stdout=output, stderr=output, stdin=subprocess.DEVNULL)
        running.append((name, process, log))
        return log

    try:
        yield run
    finally:
        ended = [_interrupt(process) for _, process, _ in running]
    for (name, _, log), status in zip(running, ended, strict=True):
        assert status == 0, f"{name} ended with {status}:\n{log.read_text()}"
        assert "Traceback" not in log.read_text()
        assert "[ERROR]" not in log.read_text()


def _interrupt(process: subprocess.Popen[bytes]) -> int:
    """Interrupt a node and return its exit status; kill it if it does not end."""
    process.send_signal(signal.SIGINT)
    try:
        return process.wait(60)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()
