# SPDX-License-Identifier: Apache-2.0
"""Managed nodes in this process: states, release, parameters at run time, several of them side by side."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.node.component_node import ComponentNode
from flowing_puppet_ros.node.factory import RosMessageFactory
from flowing_puppet_ros.stream.messages.geometry import make_header
from flowing_puppet_ros.stream.messages.images import make_image

pytestmark = pytest.mark.ros
FACTORY = RosMessageFactory()


class Bench:
    """Nodes on one executor."""

    def __init__(self) -> None:
        """Start with a peer that publishes and listens."""
        self.executor = SingleThreadedExecutor()
        self.peer = self.add(Node("peer"))
        self.received: dict[str, list[Image]] = {}

    def add(self, node: Any) -> Any:
        """Spin this node too."""
        self.executor.add_node(node)
        return node

    def start(self, name: str, namespace: str = "", **parameters: Any) -> ComponentNode[Any]:
        """Start a node of ours."""
        given = [Parameter(key, value=value) for key, value in {"queue": 5, **parameters}.items()]
        return self.add(ComponentNode(name, namespace=namespace, parameter_overrides=given))

    def spin_until(self, condition: Callable[[], object], what: str) -> None:
        """Take messages until `condition` holds."""
        until = time.monotonic() + 60
        while not condition():
            assert time.monotonic() < until, f"waited in vain for {what}"
            self.executor.spin_once(timeout_sec=0.02)

    def ask(self, kind: Any, service: str, request: Any) -> Any:
        """Return the answer of a service."""
        client = self.peer.create_client(kind, service)
        self.spin_until(client.service_is_ready, service)
        future = client.call_async(request)
        self.spin_until(future.done, f"an answer of {service}")
        return future.result()

    def change(self, node: str, transition: int) -> bool:
        """Ask a node for a transition."""
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(self.ask(ChangeState, f"{node}/change_state", request).success)

    def set(self, node: str, **values: Any) -> list[Any]:
        """Return the results of setting parameters through the service."""
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        return list(
            self.ask(SetParameters, f"{node}/set_parameters", SetParameters.Request(parameters=parameters)).results
        )

    def flows(self, namespace: str = "") -> int:
        """Publish two images and return how many flows came."""
        topic = f"{namespace}/flow/forward"
        if topic not in self.received:
            found = self.received[topic] = []
            self.peer.create_subscription(Image, topic, found.append, 10)
        publisher = self.peer.create_publisher(Image, f"{namespace}/image", 10)
        self.spin_until(lambda: publisher.get_subscription_count() and self.peer.count_publishers(topic), topic)
        count = len(self.received[topic])
        for number in (1, 2):
            publisher.publish(picture(len(self.received[topic]) * 2 + number))
        self.spin_until(lambda: len(self.received[topic]) > count, topic)
        self.peer.destroy_publisher(publisher)
        return len(self.received[topic]) - count


def picture(number: int) -> Image:
    """Return a grey image."""
    pixels = np.random.default_rng(0).integers(0, 255, (64, 64)).astype(np.uint8)
    return make_image(FACTORY, make_header(FACTORY, number * 10**9, "camera"), np.roll(pixels, number, 1), "mono8")


@pytest.fixture
def bench() -> Iterator[Bench]:
    """Return an empty bench."""
    rclpy.init()
    made = Bench()
    yield made
    for node in made.executor.get_nodes():
        node.destroy_node()
    rclpy.try_shutdown()


def test_a_manager_leads_a_node_through_its_life(bench: Bench) -> None:
    node = bench.start("optical_flow", autostart=False)
    assert node.state == "unconfigured"
    assert not bench.peer.count_publishers("flow/forward")
    assert not bench.change("optical_flow", Transition.TRANSITION_ACTIVATE), "only what is configured can be activated"
    assert bench.change("optical_flow", Transition.TRANSITION_CONFIGURE)
    bench.spin_until(lambda: bench.peer.count_publishers("flow/forward"), "the output")
    assert not bench.peer.count_subscribers("image")
    for _ in range(2):
        assert bench.change("optical_flow", Transition.TRANSITION_ACTIVATE)
        assert bench.flows() == 1
        assert bench.change("optical_flow", Transition.TRANSITION_DEACTIVATE)
        bench.spin_until(lambda: not bench.peer.count_subscribers("image"), "the end of the input")
    assert bench.change("optical_flow", Transition.TRANSITION_CLEANUP)
    bench.spin_until(lambda: not bench.peer.count_publishers("flow/forward"), "the end of the output")
    assert bench.change("optical_flow", Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)
    assert node.state == "finalized"


def test_what_cannot_be_configured_says_why_and_stays_unconfigured(bench: Bench) -> None:
    node = bench.start("visual_hull", autostart=False, cameras="one")
    assert not bench.change("visual_hull", Transition.TRANSITION_CONFIGURE)
    assert node.state == "unconfigured"
    assert node.problem == "cameras is 'one': a visual hull needs two or more different names"
    with pytest.raises(InputError, match="cameras is 'one'"):
        bench.start("visual_hull", "other", cameras="one")


def test_parameters_change_at_run_time_or_are_refused_in_a_sentence(bench: Bench) -> None:
    node = bench.start("optical_flow", preset="fast")
    assert bench.flows() == 1
    for name, value, reason in (
        ("max_side", 3, "out of range"),
        ("preset", "best", "preset is 'best', which is not one of ultrafast, fast, medium"),
        ("max_side", 0.5, "Wrong parameter type"),
        ("autostart", False, "read-only"),
    ):
        (refused,) = bench.set("optical_flow", **{name: value})
        assert not refused.successful and reason in refused.reason
    assert node.get_parameter("preset").value == "fast"
    results = bench.set("optical_flow", preset="ultrafast", max_side=32, queue=9)
    assert all(result.successful for result in results)
    assert bench.flows() == 1
    assert node.session is not None
    assert (node.session.component.settings.max_side, node.session.worker.limit) == (32, 9)


def test_two_nodes_of_a_kind_live_side_by_side(bench: Bench) -> None:
    bench.start("optical_flow", "left")
    right = bench.start("optical_flow", "right", max_side=32)
    assert bench.flows("/left") == bench.flows("/right") == 1
    bench.executor.remove_node(right)
    right.destroy_node()
    assert bench.flows("/left") == 1
