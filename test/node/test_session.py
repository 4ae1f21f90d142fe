# SPDX-License-Identifier: Apache-2.0
"""A session's topics: those of people come and go with them, and what is set for one topic is not set for another."""

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from pathlib import Path
from threading import Event
from typing import Any

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from flowing_puppet_ros.node.diagnostics import Diagnostics
from flowing_puppet_ros.node.factory import RosMessageFactory
from flowing_puppet_ros.node.inputs import CHECK_INTERVAL_S
from flowing_puppet_ros.node.session import Session
from flowing_puppet_ros.settings import Settings
from flowing_puppet_ros.stream.component import Component, Output, Port

pytestmark = pytest.mark.ros
TEXT = "std_msgs/msg/String"


class Names(Component[Settings]):
    """Says who is there: a message names the people, and each of them gets a topic of their own."""

    settings_type = Settings
    inputs = (Port("names", TEXT, "sensor"), Port("other", TEXT, "sensor"))
    outputs = (Port("all", TEXT), Port("more", TEXT), Port("people/{id}/name", TEXT, "latched"))

    def __init__(self) -> None:
        """Know nobody."""
        super().__init__(Settings(), RosMessageFactory())
        self._known: list[str] = []

    def _process(self, port: str, message: Any) -> Output:
        (_, _, own), names = self.outputs, message.data.split()
        gone: Output = [(own.person_topic(name), None) for name in self._known if name not in names]
        self._known = names
        return [*gone, ("all", message), *((own.person_topic(name), String(data=name)) for name in names)]


@pytest.fixture
def open_session() -> Iterator[Callable[..., tuple[Node, Session[Names]]]]:
    """Return a function that opens and activates a session on a node with these parameters."""
    rclpy.init()
    opened: list[tuple[Node, Session[Names]]] = []

    def run(**parameters: Any) -> tuple[Node, Session[Names]]:
        given = [Parameter(name, value=value) for name, value in parameters.items()]
        node = Node("names", parameter_overrides=given)
        session = Session(node, Names(), 10, Diagnostics("/names", "names"))
        opened.append((node, session))
        session.activate()
        return node, session

    yield run
    for node, session in opened:
        session.close()
        node.destroy_node()
    rclpy.try_shutdown()


class Extras(Component[Settings]):
    """Repeats names on two topics, whose message packages a machine may lack."""

    settings_type = Settings
    inputs = (Port("names", TEXT, "sensor"),)
    outputs = (
        Port("there", "extra_msgs/msg/Text", lazy=True, optional=True),
        Port("missing", "absent_msgs/msg/Text", lazy=True, optional=True),
    )

    def __init__(self) -> None:
        """Make it."""
        super().__init__(Settings(), RosMessageFactory())

    def _process(self, port: str, message: Any) -> Output:
        return [(name, message) for name in sorted(self._subscribed)]


def people(node: Node) -> set[str]:
    """The people whose topics this node has open."""
    topics = [publisher.topic_name for publisher in node.publishers if publisher.topic_name.startswith("/people/")]
    assert len(set(topics)) == len(topics)
    return {topic.split("/")[2] for topic in topics}


def tell(session: Session[Names], text: str) -> None:
    """Publish what the component says of a message."""
    session.publish(session.component.handle("names", String(data=text)))


def test_a_persons_topic_is_there_while_the_person_is(open_session: Callable[..., tuple[Node, Session[Names]]]) -> None:
    node, session = open_session()
    assert people(node) == set()
    tell(session, "ann bob")
    before = len(node._parameters)
    assert people(node) == {"ann", "bob"}
    tell(session, "bob cid")
    assert people(node) == {"bob", "cid"}
    assert len(node._parameters) == before, "people who come and go leave nothing behind"
    own = next(publisher for publisher in node.publishers if publisher.topic_name == "/people/bob/name")
    assert own.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL


def test_people_who_are_forgotten_have_no_topics(open_session: Callable[..., tuple[Node, Session[Names]]]) -> None:
    node, session = open_session()
    tell(session, "ann")
    session.deactivate()
    done: list[bool] = []
    session.worker.call(lambda: done.append(True))
    while not done:
        pass
    assert people(node) == set() and [p.topic_name for p in node.publishers][-2:] == ["/all", "/more"]
    tell(session, "ann")
    assert people(node) == set(), "an inactive session publishes nothing"
    session.activate()
    tell(session, "bob")
    assert people(node) == {"bob"}
    session.close()
    assert not [p for p in node.publishers if p.topic_name in ("/all", "/more", "/people/bob/name")]


def test_a_closed_session_stops_what_runs_in_the_background(
    open_session: Callable[..., tuple[Node, Session[Names]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, session = open_session()
    assert isinstance(session.component.background, Executor)
    stopped: list[bool] = []
    monkeypatch.setattr(session.component, "reset", lambda: stopped.append(True))
    session.close()
    assert stopped


def test_an_override_changes_its_own_topic_only(open_session: Callable[..., tuple[Node, Session[Names]]]) -> None:
    overrides = {
        "qos_overrides./names.subscription.reliability": "reliable",
        "qos_overrides./all.publisher.reliability": "best_effort",
    }
    for parameters, first in ((overrides, ReliabilityPolicy.RELIABLE), ({}, ReliabilityPolicy.BEST_EFFORT)):
        node, _ = open_session(**parameters)
        subscribed = {made.topic_name: made.qos_profile.reliability for made in node.subscriptions}
        published = {made.topic_name: made.qos_profile.reliability for made in node.publishers}
        assert subscribed["/names"] == first and subscribed["/other"] == ReliabilityPolicy.BEST_EFFORT
        assert (published["/all"] == ReliabilityPolicy.BEST_EFFORT) == bool(parameters)
        assert published["/more"] == ReliabilityPolicy.RELIABLE


def test_a_publisher_whose_qos_does_not_fit_is_one_warning_with_topic_and_cure(
    open_session: Callable[..., tuple[Node, Session[Names]]],
) -> None:
    node, session = open_session(**{"qos_overrides./names.subscription.reliability": "reliable"})
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    said: list[str] = []
    session._warn = lambda sentence: said.append(sentence)  # type: ignore[method-assign]
    other = Node("other")
    publisher = other.create_publisher(String, "names", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    until = time.monotonic() + 60
    while not said and time.monotonic() < until:
        publisher.publish(String(data="ann"))
        executor.spin_once(timeout_sec=0.1)
    executor.shutdown()
    other.destroy_node()
    assert said == [
        "/names: a publisher offers another reliability, so they do not connect; set "
        "qos_overrides./names.subscription.reliability of this node, or the reliability of the other, to fit"
    ]


def test_outputs_of_optional_packages_are_made_where_these_are_installed_and_wanted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "extra_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text("from std_msgs.msg import String as Text\n")
    monkeypatch.syspath_prepend(tmp_path)
    rclpy.init()
    node, other = Node("extras"), Node("other")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    executor.add_node(other)
    session = Session(node, Extras(), 10, Diagnostics("/extras", "extras"))
    session.activate()
    said: list[str] = []
    session._warn = lambda sentence: said.append(sentence)  # type: ignore[method-assign]
    names = other.create_publisher(String, "names", 10)
    heard: list[String] = []

    def spin_until(condition: Callable[[], object]) -> None:
        until = time.monotonic() + 60
        while not condition():
            executor.spin_once(timeout_sec=0.02)
            assert time.monotonic() < until

    try:
        spin_until(lambda: other.count_publishers("there") and names.get_subscription_count())
        assert not other.count_publishers("missing")
        spin_until(lambda: names.publish(String(data="nobody listens")) or session.component.counters["received names"])
        assert not session.component._subscribed and not said, "what nobody asks for is not made and not missed"
        other.create_subscription(String, "there", heard.append, 10)
        spin_until(lambda: node.count_subscribers("there"))
        for _ in range(2):
            other.create_subscription(String, "missing", heard.append, 10)
        until = time.monotonic() + 6 * CHECK_INTERVAL_S
        while String(data="ann") not in heard or not said or time.monotonic() < until:
            assert time.monotonic() < until + 60
            names.publish(String(data="ann"))
            executor.spin_once(timeout_sec=0.02)
        assert said == ["/missing is not published, since absent_msgs is not installed: install ros-jazzy-absent-msgs"]
    finally:
        session.close()
        executor.shutdown()
        node.destroy_node()
        other.destroy_node()
        rclpy.try_shutdown()


def test_latched_messages_are_not_dropped_while_the_worker_is_busy(
    open_session: Callable[..., tuple[Node, Session[Names]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, session = open_session()
    session.worker.limit, busy, handled = 1, Event(), []
    monkeypatch.setattr(session, "_handle", lambda port, topic, message: handled.append((port, message.data)))
    session.worker.call(lambda: busy.wait(10) and None)
    for number in range(3):
        session._on_message(Port("names", TEXT, "latched"), "/names", String(data=str(number)))
        session._on_message(Port("other", TEXT, "sensor"), "/other", String(data=str(number)))
    done = Event()
    session.worker.call(done.set)
    busy.set()
    assert done.wait(10)
    assert handled == [("names", "0"), ("names", "1"), ("names", "2"), ("other", "2")]
