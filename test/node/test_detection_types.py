# SPDX-License-Identifier: Apache-2.0
"""Inputs that understand several types follow what is published there, and a list of bodies brings their topics."""

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
from flowing_puppet_msgs.msg import PuppetArray
from geometry_msgs.msg import Point
from hri_msgs.msg import IdsList, Skeleton2D
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import Header, String

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.ids import make_public_id
from flowing_puppet_ros.node.component_node import ComponentNode
from flowing_puppet_ros.node.diagnostics import Diagnostics
from flowing_puppet_ros.node.factory import RosMessageFactory
from flowing_puppet_ros.node.inputs import choose_type
from flowing_puppet_ros.node.session import Session
from flowing_puppet_ros.settings import Settings
from flowing_puppet_ros.stream.component import Component, Output, Port
from flowing_puppet_ros.stream.components.puppet_tracker import PuppetTrackerComponent, PuppetTrackerSettings
from flowing_puppet_ros.stream.messages.detections import BodySkeleton
from flowing_puppet_ros.stream.messages.geometry import stamp_ns
from test.helpers.foreign_detections import make_ids, make_skeleton

pytestmark = pytest.mark.ros
GOLDEN = Path(__file__).resolve().parents[2] / "bags" / "golden" / "golden.mcap"
SIZE = (192, 240)
HEADER = "std_msgs/msg/Header"
YOLO, ZED = "yolo_msgs/msg/DetectionArray", "zed_msgs/msg/ObjectsStamped"
PORT = Port("names", "std_msgs/msg/String", "sensor", optional=True, alternatives=(YOLO, "hri_msgs/msg/IdsList"))
FACTORY = RosMessageFactory()


class Collector(Component[Settings]):
    """Keeps what comes, and whether anything is expected."""

    settings_type = Settings
    inputs = (replace(PORT, alternatives=(HEADER, *PORT.alternatives)), Port("tick", PORT.type))
    outputs = (Port("made", PORT.type),)

    def __init__(self) -> None:
        """Have nothing."""
        super().__init__(Settings(), FACTORY)
        self.messages: list[Any] = []
        self.expecting: list[bool] = []

    def _process(self, port: str, message: Any) -> Output:
        (self.messages if port == "names" else self.expecting).append(
            message if port == "names" else "names" in self._expected
        )
        return []


class Bench:
    """One session, or one node of ours, and a peer on an executor."""

    def __init__(self) -> None:
        """Start with the peer, on a participant of its own: the middleware knows one type for a topic in each."""
        rclpy.init()
        self._context = rclpy.Context()
        self._context.init()
        self._executors = SingleThreadedExecutor(), SingleThreadedExecutor(context=self._context)
        self.peer = Node("peer", context=self._context)
        self._executors[1].add_node(self.peer)
        self._opened: list[Any] = []

    def open(self, *arguments: str) -> tuple[Session[Collector], list[str]]:
        """Return an active session whose node has these ROS arguments, and the list of its warnings."""
        node = self.add(Node("own", cli_args=["--ros-args", *arguments], use_global_arguments=False))
        session = Session(node, Collector(), 5, Diagnostics("/own", "own"))
        self._opened.append(session.close)
        said: list[str] = []
        session._warn = lambda sentence: said.append(sentence)  # type: ignore[method-assign]
        session.activate()
        return session, said

    def add(self, node: Any) -> Any:
        """Spin this node of ours too."""
        self._executors[0].add_node(node)
        self._opened.append(node.destroy_node)
        return node

    def spin_until(self, condition: Callable[[], object], what: str) -> None:
        """Take messages until `condition` holds."""
        until = time.monotonic() + 60
        while not condition():
            assert time.monotonic() < until, f"waited in vain for {what}"
            for executor in self._executors:
                executor.spin_once(timeout_sec=0.01)

    def close(self) -> None:
        """Close all, the last first."""
        for close in reversed(self._opened):
            close()
        for executor in self._executors:
            executor.shutdown()
        self.peer.destroy_node()
        self._context.try_shutdown()
        rclpy.try_shutdown()


@pytest.fixture
def bench() -> Iterator[Bench]:
    made = Bench()
    yield made
    made.close()


def test_an_input_follows_the_type_that_is_published(bench: Bench) -> None:
    session, said = bench.open()
    for kind, message in ((Header, Header(frame_id="a")), (String, String(data="b")), (Header, Header(frame_id="c"))):
        publisher = bench.peer.create_publisher(kind, "names", 10)

        def heard(publisher: Any = publisher, message: Any = message) -> bool:
            publisher.publish(message)
            return message in session.component.messages

        bench.spin_until(heard, f"a {kind.__name__}")
        bench.peer.destroy_publisher(publisher)
        bench.spin_until(lambda: not bench.peer.count_publishers("names"), "the end of the publisher")
    assert said == []


def test_a_type_that_is_not_understood_is_named_once_and_not_waited_for(bench: Bench) -> None:
    session, said = bench.open()
    other, tick = bench.peer.create_publisher(Point, "names", 10), bench.peer.create_publisher(String, "tick", 10)

    def ticked() -> bool:
        other.publish(Point())
        tick.publish(String())
        return bool(said) and session.component.expecting[-1:] == [False]

    bench.spin_until(ticked, "the warning")
    (sentence,) = said
    assert sentence.startswith("/names: geometry_msgs/msg/Point is published, which is not understood; understood are ")
    assert YOLO in sentence and "hri_msgs/msg/IdsList" in sentence
    assert session.component.messages == []


def test_a_list_of_bodies_brings_their_skeletons(bench: Bench) -> None:
    session, said = bench.open("-r", "names:=/humans/bodies/tracked")
    listing = bench.peer.create_publisher(IdsList, "/humans/bodies/tracked", 10)
    skeletons = {
        name: bench.peer.create_publisher(Skeleton2D, f"/humans/bodies/{name}/skeleton2d", 10)
        for name in ("ada", "zoe")
    }
    received = session.component.messages

    def bodies() -> set[str]:
        listing.publish(make_ids(7, ["zoe", "ada", "no id"], FACTORY))
        for number, publisher in enumerate(skeletons.values()):
            publisher.publish(make_skeleton(7, {"nose": (10.0 + number, 5.0, 0.5)}, SIZE, FACTORY))
        return {message.id for message in received if isinstance(message, BodySkeleton)}

    bench.spin_until(lambda: bodies() == {"ada", "zoe"}, "both")
    (ada,) = {m.message.skeleton[0].x for m in received if isinstance(m, BodySkeleton) and m.id == "ada"}
    assert ada == pytest.approx(10.5 / 192)
    assert stamp_ns(next(message for message in received if isinstance(message, BodySkeleton))) == 7
    assert said == ["/humans/bodies/tracked: a topic cannot be named after the id 'no id'"]
    bench.peer.destroy_publisher(skeletons["ada"])
    topic = "/humans/bodies/ada/skeleton2d"

    def gone() -> bool:
        listing.publish(make_ids(8, ["zoe"], FACTORY))
        return not bench.peer.count_subscribers(topic)

    bench.spin_until(gone, "the end of the body's subscription")
    session.deactivate()
    bench.spin_until(lambda: not bench.peer.count_subscribers(topic.replace("ada", "zoe")), "the end of the other")


def test_a_node_does_not_take_its_own_results(bench: Bench) -> None:
    with pytest.raises(InputError, match="names is /made, which this node itself publishes"):
        bench.open("-r", "names:=made")


def test_a_foreign_type_is_imported_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    assert choose_type([], PORT, PORT.type) == PORT.type
    assert choose_type([YOLO, PORT.type], PORT, PORT.type) == PORT.type, "what is subscribed to stays"
    with pytest.raises(InputError, match=r"DetectionArray is published, but yolo_msgs is not installed: source a work"):
        choose_type([YOLO], PORT, PORT.type)
    module = ModuleType("yolo_msgs.msg")
    monkeypatch.setattr(module, "DetectionArray", SimpleNamespace, raising=False)
    monkeypatch.setitem(sys.modules, "yolo_msgs", ModuleType("yolo_msgs"))
    monkeypatch.setitem(sys.modules, "yolo_msgs.msg", module)
    assert choose_type([YOLO], PORT, PORT.type) == YOLO
    assert choose_type([], PORT, YOLO) == YOLO
    with pytest.raises(InputError, match=f"{ZED} is published, which is not understood"):
        choose_type([ZED], PORT, PORT.type)


def recorded(topic: str) -> list[Any]:
    with open_bag(GOLDEN) as bag:
        return list(bag.messages([topic]))[:3]


@pytest.mark.slow
def test_the_tracker_takes_the_bodies_of_ros4hri(bench: Bench) -> None:
    """The node tracks from skeletons whom it tracks from the same keypoints in our own message."""
    images = {stamp_ns(record.message): record for record in recorded("/cam1/image/compressed")}
    own = {stamp_ns(record.message): record.message for record in recorded("/cam1/detections")}
    settings = {"parts": 10}
    alone = PuppetTrackerComponent(PuppetTrackerSettings.from_mapping(settings), FACTORY)
    alone.set_expected("detections", True)
    expected = {}
    for stamp, record in images.items():
        alone.handle("detections", own[stamp])
        for port, message in alone.handle("image", record.message):
            if port == "puppets":
                expected[stamp] = message
    assert [len(message.puppets) for message in expected.values()] == [1, 1, 1]

    arguments = ["--ros-args", "-r", "detections:=/humans/bodies/tracked", "-p", "parts:=10", "-p", "queue:=10"]
    arguments += ["-p", "detection.source:=none"]
    node = bench.add(ComponentNode("puppet_tracker", cli_args=arguments, use_global_arguments=False))
    found: dict[int, Any] = {}

    def keep(message: PuppetArray) -> None:
        found[stamp_ns(message)] = message

    bench.peer.create_subscription(PuppetArray, "puppets", keep, 10)
    listing = bench.peer.create_publisher(IdsList, "/humans/bodies/tracked", 10)
    skeleton = bench.peer.create_publisher(Skeleton2D, "/humans/bodies/ada/skeleton2d", 10)
    image = bench.peer.create_publisher(CompressedImage, "image/compressed", 10)

    def joined() -> bool:
        listing.publish(make_ids(1, ["ada"], FACTORY))
        return all(made.get_subscription_count() for made in (skeleton, image)) and bool(
            node.count_publishers("puppets")
        )

    bench.spin_until(joined, "the node's subscriptions")
    for stamp, record in images.items():
        joints = {joint.name: (joint.x, joint.y, joint.confidence) for joint in own[stamp].puppets[0].joints}
        image.publish(deserialize_message(record.raw, CompressedImage))
        skeleton.publish(make_skeleton(stamp, joints, SIZE, FACTORY))
        listing.publish(make_ids(stamp, ["ada"], FACTORY))
        bench.spin_until(partial(found.__contains__, stamp), "puppets")
    for stamp, message in expected.items():
        (puppet,), (other,) = found[stamp].puppets, message.puppets
        assert puppet.id == make_public_id("/puppet_tracker", other.id)
        for joint, same in zip(puppet.joints, other.joints, strict=True):
            np.testing.assert_allclose((joint.x, joint.y), (same.x, same.y), atol=0.01)
