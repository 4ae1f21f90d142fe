# SPDX-License-Identifier: Apache-2.0
"""Raw or compressed images, never both: what is published, what a parameter says, and who comes and goes."""

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import CompressedImage, Image

from flowing_puppet_ros.node.component_node import ComponentNode
from flowing_puppet_ros.node.diagnostics import Diagnostics
from flowing_puppet_ros.node.factory import RosMessageFactory
from flowing_puppet_ros.node.inputs import AUTO, CHECK_INTERVAL_S, COMPRESSED, RAW, TransportChoice
from flowing_puppet_ros.node.session import Session
from flowing_puppet_ros.settings import Settings
from flowing_puppet_ros.stream.component import Component, Output, Port
from flowing_puppet_ros.stream.messages.geometry import make_header
from flowing_puppet_ros.stream.messages.images import compress_image, make_image

pytestmark = pytest.mark.ros
FACTORY = RosMessageFactory()
IMAGE = "sensor_msgs/msg/Image"


@pytest.mark.parametrize(
    ("setting", "publishers", "chosen"),
    [
        (AUTO, [(0, 0), (0, 0)], [RAW, RAW]),
        (AUTO, [(1, 1), (1, 1), (1, 1)], [RAW, RAW, RAW]),
        (AUTO, [(0, 1), (0, 1), (1, 1), (1, 1), (1, 1)], [RAW, COMPRESSED, COMPRESSED, COMPRESSED, COMPRESSED]),
        (AUTO, [(0, 1), (1, 1), (1, 1), (1, 1)], [RAW, RAW, RAW, RAW]),
        (AUTO, [(1, 0), (0, 0), (0, 1), (0, 1)], [RAW, RAW, RAW, COMPRESSED]),
        (AUTO, [(0, 2), (0, 2), (1, 0), (1, 0)], [RAW, COMPRESSED, COMPRESSED, RAW]),
        (AUTO, [(0, 1), (0, 1), (0, 0), (1, 1), (1, 1)], [RAW, COMPRESSED, COMPRESSED, COMPRESSED, RAW]),
        (AUTO, [(0, 1), (0, 1), (0, 0), (0, 1), (1, 1)], [RAW, COMPRESSED, COMPRESSED, COMPRESSED, COMPRESSED]),
        (RAW, [(0, 1), (0, 1), (0, 1)], [RAW, RAW, RAW]),
        (COMPRESSED, [(1, 0), (1, 0), (1, 1)], [COMPRESSED, COMPRESSED, COMPRESSED]),
    ],
)
def test_the_choice_follows_the_publishers(
    setting: str, publishers: Sequence[tuple[int, int]], chosen: Sequence[str]
) -> None:
    choice = TransportChoice(setting)
    assert [choice.update(raw, compressed) for raw, compressed in publishers] == list(chosen)


class TwoCameras(Component[Settings]):
    """Takes a picture and a depth image."""

    settings_type = Settings
    inputs = (
        Port("image", IMAGE, "sensor", transport="compressed"),
        Port("depth", IMAGE, "sensor", transport="compressedDepth"),
    )
    outputs = ()

    def __init__(self) -> None:
        """Make it."""
        super().__init__(Settings(), FACTORY)

    def _process(self, port: str, message: Any) -> Output:
        return []


class Stage:
    """Publishers of images, and nodes that listen."""

    def __init__(self) -> None:
        """Start with nobody."""
        self._executor = SingleThreadedExecutor()
        self.peer = self.add(Node("peer"))
        self._sessions: list[Session[TwoCameras]] = []

    def add(self, node: Any) -> Any:
        """Spin this node too."""
        self._executor.add_node(node)
        return node

    def start(self, name: str = "optical_flow", **parameters: Any) -> ComponentNode[Any]:
        """Start a node of ours."""
        given = [Parameter(key, value=value) for key, value in {"queue": 5, **parameters}.items()]
        return self.add(ComponentNode(name, parameter_overrides=given))

    def open_session(self, node: Node) -> None:
        """Listen to a picture and a depth image."""
        session = Session(self.add(node), TwoCameras(), 5, Diagnostics("/cameras", "cameras"))
        self._sessions.append(session)
        session.activate()

    def publish(self, *topics: str) -> list[Any]:
        """Return a publisher for each topic."""
        kinds = [CompressedImage if "compressed" in topic else Image for topic in topics]
        return [self.peer.create_publisher(kind, topic, 10) for kind, topic in zip(kinds, topics, strict=True)]

    def spin_until(self, condition: Callable[[], object], what: str) -> None:
        """Work until `condition` holds."""
        until = time.monotonic() + 60
        while not condition():
            assert time.monotonic() < until, f"waited in vain for {what}"
            self._executor.spin_once(timeout_sec=0.02)

    def spin_for_checks(self, node: Node, count: int = 5) -> None:
        """Work until a node has looked at the publishers some times more; it never listens to both of an image."""
        until = time.monotonic() + (count + 0.5) * CHECK_INTERVAL_S
        while time.monotonic() < until:
            self._executor.spin_once(timeout_sec=0.02)
            assert len({topic.split("/")[1] for topic in listening(node)}) == len(listening(node))

    def close(self) -> None:
        """End everything."""
        for session in self._sessions:
            session.close()
        for node in self._executor.get_nodes():
            node.destroy_node()


def listening(node: Node) -> list[str]:
    """Return the image topics that a node subscribes to."""
    return sorted(made.topic_name for made in node.subscriptions if made.msg_type in (Image, CompressedImage))


@pytest.fixture
def stage() -> Iterator[Stage]:
    """Return an empty stage."""
    rclpy.init()
    made = Stage()
    yield made
    made.close()
    rclpy.try_shutdown()


def test_a_camera_that_offers_both_encodes_nothing_for_us(stage: Stage) -> None:
    raw, compressed = stage.publish("image", "image/compressed")
    node = stage.start()
    stage.spin_until(raw.get_subscription_count, "a subscriber")
    for _ in range(4):
        stage.spin_for_checks(node, 1)
        assert (raw.get_subscription_count(), compressed.get_subscription_count()) == (1, 0)


def test_compressed_images_are_taken_where_there_are_no_others_until_they_end(stage: Stage) -> None:
    (compressed,) = stage.publish("image/compressed")
    node = stage.start()
    stage.spin_until(compressed.get_subscription_count, "a subscriber of compressed images")
    assert listening(node) == ["/image/compressed"] == (node.session.topics if node.session else [])
    (raw,) = stage.publish("image")
    stage.spin_for_checks(node)
    assert listening(node) == ["/image/compressed"], "what works is kept"
    stage.peer.destroy_publisher(compressed)
    stage.spin_until(raw.get_subscription_count, "a subscriber of raw images")
    assert listening(node) == ["/image"]


def test_settings_are_obeyed_and_can_be_changed(stage: Stage) -> None:
    raw, compressed = stage.publish("image", "image/compressed")
    node = stage.start(image_transport="compressed")
    stage.spin_until(compressed.get_subscription_count, "a subscriber of compressed images")
    stage.spin_for_checks(node)
    assert (raw.get_subscription_count(), compressed.get_subscription_count()) == (0, 1)
    node.set_parameters([Parameter("image_transport", value="raw")])
    stage.spin_until(raw.get_subscription_count, "a subscriber of raw images")
    stage.peer.destroy_publisher(raw)
    stage.spin_for_checks(node)
    assert listening(node) == ["/image"]
    (refused,) = node.set_parameters([Parameter("image_transport", value="theora")])
    assert refused.reason == "image_transport is 'theora', which is not one of auto, raw, compressed"


def test_a_publisher_that_starts_late_is_found(stage: Stage) -> None:
    node = stage.start(max_side=32)
    flows: list[Image] = []
    stage.peer.create_subscription(Image, "flow/forward", flows.append, 10)
    stage.spin_for_checks(node)
    assert listening(node) == ["/image"]
    (late,) = stage.publish("image/compressed")
    stage.spin_until(lambda: late.get_subscription_count() and stage.peer.count_publishers("flow/forward"), "the node")
    pixels = np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8)
    for number in (1, 2):
        image = make_image(FACTORY, make_header(FACTORY, number * 10**9, "camera"), pixels, "rgb8")
        late.publish(compress_image(FACTORY, image))
    stage.spin_until(lambda: flows, "the flow")


def test_each_image_has_its_own_transport_and_topics_may_be_remapped(stage: Stage) -> None:
    node = Node("cameras", cli_args=["--ros-args", "-r", "image:=/left/rgb", "-r", "depth:=/right/depth"])
    raw, unused, packed = stage.publish("/left/rgb", "/left/rgb/compressed", "/right/depth/compressedDepth")
    stage.open_session(node)
    stage.spin_until(lambda: raw.get_subscription_count() and packed.get_subscription_count(), "both images")
    stage.spin_for_checks(node)
    assert listening(node) == ["/left/rgb", "/right/depth/compressedDepth"]
    assert unused.get_subscription_count() == 0
