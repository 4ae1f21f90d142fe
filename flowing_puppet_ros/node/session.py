# SPDX-License-Identifier: Apache-2.0
"""A component at work on the topics of a node, from configuring to cleaning up."""

from __future__ import annotations

import threading
import traceback
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from functools import cache, partial
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import NameValidationException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_policy_name_from_kind, qos_profile_sensor_data
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.node.diagnostics import Diagnostics
from flowing_puppet_ros.node.factory import message_type
from flowing_puppet_ros.node.inputs import (
    AUTO,
    CHECK_INTERVAL_S,
    COMPRESSED,
    BodyTopics,
    TransportChoice,
    check_no_loop,
    choose_type,
)
from flowing_puppet_ros.node.outputs import Outputs, transport_topic
from flowing_puppet_ros.node.worker import Worker
from flowing_puppet_ros.stream.component import Component, Output, Port
from flowing_puppet_ros.stream.messages.detections import BodySkeleton
from flowing_puppet_ros.stream.messages.geometry import header_ns
from flowing_puppet_ros.stream.messages.message_types import COMPRESSED_IMAGE, TRANSFORMS
from flowing_puppet_ros.stream.pairing.time_synchronizer import BACKWARD_JUMP_NS
from flowing_puppet_ros.units import NANOSECONDS

LOG_INTERVAL_S = 5.0
"""Minimum seconds between two log lines about failed messages."""
MAX_STAMP_LEAD_NS = NANOSECONDS
"""Maximum nanoseconds that a stamp may be ahead of the node's clock; a later one is from another clock."""
_SUBSCRIPTION_QOS = {
    "sensor": qos_profile_sensor_data,
    "reliable": QoSProfile(depth=10),
    "latched": QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL),
}
_PEOPLE_FIELDS = {"puppets": "puppets", "bodies": "bodies"}
"""Output ports whose messages list people, and the field that does."""


class Session[C: Component[Any]]:
    """Runs one component on live topics.

    Callbacks only queue messages; the worker thread passes them to the component in order of arrival and publishes
    the results. The session survives any message. What the worker still computes when the session is deactivated or
    closed is not published.
    """

    def __init__(
        self, node: Node, component: C, queue: int, diagnostics: Diagnostics, image_transport: str = AUTO
    ) -> None:
        """Open the outputs and start the worker; the inputs are opened by `activate`."""
        self.component = component
        self.image_transport = image_transport
        self.active = False
        self._node = node
        self._diagnostics = diagnostics
        self._publishing = threading.Lock()
        self._last_stamp: int | None = None
        self._warned: set[str] = set()
        self._subscriptions: dict[str, Subscription] = {}
        self._transports: dict[str, TransportChoice] = {}
        self._types = {port.name: port.type for port in component.inputs}
        self._unusable: set[str] = set()
        self._watch: Timer | None = None
        self._topics = {port.name: _resolve_topic(node, port.name) for port in component.inputs}
        self._optional = {port.name: self._topics[port.name] for port in component.inputs if port.optional}
        outputs = {_resolve_topic(node, port.name) for port in component.outputs if not port.per_person}
        check_no_loop(self._topics, component.inputs, outputs)
        self._bodies = {
            port.name: BodyTopics(
                node, _SUBSCRIPTION_QOS[port.qos], partial(self._on_skeleton, port.name), self._warn_once
            )
            for port in component.inputs
            if port.alternatives
        }
        self._outputs = Outputs(node, component, self._on_incompatible_qos)
        component.background = _background_executor()
        self.worker = Worker(max(queue, component.min_queue), self._on_task_error)
        component.is_behind = self.worker.is_behind

    def activate(self) -> None:
        """Open the inputs."""
        self._diagnostics.reset_silence()
        self.active = True
        for port in self.component.inputs:
            if port.transport:
                self._transports[port.name] = TransportChoice(self.image_transport)
            if port.alternatives:
                self._follow_type(port)
            else:
                self._subscribe(port)
        # On the clock of the machine, since simulated time may stand still.
        self._watch = self._node.create_timer(
            CHECK_INTERVAL_S, self._follow_others, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    def deactivate(self) -> None:
        """Close the inputs and drop what waits; the outputs stay open but silent."""
        with self._publishing:
            self.active = False
        if self._watch is not None:
            self._node.destroy_timer(self._watch)
            self._watch = None
        for name in list(self._subscriptions):
            self._node.destroy_subscription(self._subscriptions.pop(name))
        for bodies in self._bodies.values():
            bodies.close()
        self.reset()

    def close(self) -> None:
        """Let the running task end, then close the outputs."""
        self.deactivate()
        self.worker.stop()
        # The worker accepts no more tasks; what runs in the background must end too.
        self.component.reset()
        self._outputs.close()

    def reset(self) -> None:
        """Drop the messages that wait; the next one starts a new recording."""
        self.worker.clear()
        self.worker.call(self._reset)

    def _reset(self) -> None:
        self.component.reset()
        self._last_stamp = None
        with self._publishing:
            self._outputs.close_people()

    @property
    def stamped(self) -> bool:
        """Whether a message with a stamp arrived since the last reset."""
        return self._last_stamp is not None

    def is_ahead_of(self, now_ns: int) -> bool:
        """Return whether the newest stamp is clearly later than `now_ns`, so that the time must have jumped back."""
        last = self._last_stamp
        return last is not None and last > now_ns + BACKWARD_JUMP_NS

    @property
    def topics(self) -> list[str]:
        """The full names of the topics that the component cannot do without."""
        return [topic for name, topic in self._topics.items() if name not in self._optional]

    def _follow_others(self) -> None:
        """Subscribe to the transport and type of each input that is published now; say what is asked for in vain."""
        for port in self.component.inputs:
            if port.alternatives:
                try:
                    self._follow_type(port)
                except RuntimeError as error:  # a middleware may allow one type for a topic in a process; tried again
                    self._warn_once(f"{self._topics[port.name]}: {' '.join(str(error).split())}")
            if port.transport:
                choice = self._transports[port.name]
                choice.setting, before = self.image_transport, choice.chosen
                names = [
                    self._node.resolve_topic_name(topic) for topic in (port.name, transport_topic(self._node, port))
                ]
                if choice.update(*map(self._node.count_publishers, names)) != before:
                    self._node.destroy_subscription(self._subscriptions.pop(port.name))
                    self._subscribe(port)
        for sentence in self._outputs.find_missing():
            self._warn_once(sentence)

    def _follow_type(self, port: Port) -> None:
        """Subscribe to an input as the type that is published there."""
        topic, present = self._topics[port.name], self._types[port.name]
        published = {info.topic_type for info in self._node.get_publishers_info_by_topic(topic)}
        try:
            chosen = choose_type(published, port, present)
            self._unusable.discard(port.name)
        except InputError as error:
            chosen = present
            self._unusable.add(port.name)
            self._warn_once(f"{topic}: {error}")
        if chosen == present and port.name in self._subscriptions:
            return
        if port.name in self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.pop(port.name))
            self._bodies[port.name].close()
        self._types[port.name] = chosen
        self._subscribe(port)

    def _subscribe(self, port: Port) -> None:
        """Open an input, for an image that with the transport that is chosen for it."""
        choice = self._transports.get(port.name)
        compressed = choice is not None and choice.chosen == COMPRESSED
        topic = transport_topic(self._node, port) if compressed else port.name
        name = self._topics[port.name] = self._node.resolve_topic_name(topic)
        self._subscriptions[port.name] = self._node.create_subscription(
            message_type(COMPRESSED_IMAGE if compressed else self._types[port.name]),
            topic,
            partial(self._on_message, port, name),
            copy(_SUBSCRIPTION_QOS[port.qos]),  # an override changes the profile itself
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=partial(self._on_incompatible_qos, name, "subscription"),
                incompatible_type=partial(self._on_incompatible_type, port, name),
                message_lost=partial(self._on_message_lost, port.name, name),
            ),
        )

    def _on_incompatible_qos(self, topic: str, side: str, event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
        other = "publisher offers" if side == "subscription" else "subscriber wants"
        cure = f"set qos_overrides.{topic}.{side}.{policy} of this node, or the {policy} of the other, to fit"
        self._warn(f"{topic}: a {other} another {policy}, so they do not connect; {cure}")

    def _on_incompatible_type(self, port: Port, topic: str, _: Any) -> None:
        if not port.alternatives:  # otherwise `_follow_type` sees to it
            self._warn(f"{topic}: another node uses another message type; remap its topic or this node's")

    def _on_message_lost(self, port: str, topic: str, event: Any) -> None:
        """Count the messages that the middleware lost; warn once, with the remedy."""
        self.component.counters[f"lost {port}"] = event.total_count
        self._warn_once(
            f"{topic}: messages are lost in transport; large ones need qos_overrides.{topic}.subscription.reliability "
            "reliable (and a reliable publisher), or compressed images"
        )

    def _warn(self, sentence: str) -> None:
        self._diagnostics.record_problem(sentence)
        self._node.get_logger().warning(sentence)

    def _warn_once(self, sentence: str) -> None:
        if sentence not in self._warned:
            self._warned.add(sentence)
            self._warn(sentence)

    def _on_message(self, port: Port, topic: str, message: Any) -> None:
        self._diagnostics.count_received(port.name)
        if port.alternatives and hasattr(message, "ids"):
            self._bodies[port.name].follow(topic, message.ids)
        task = partial(self._handle, port.name, topic, message)
        if port.qos == "latched" or port.type == TRANSFORMS:  # each says something of its own
            self.worker.call(task)
        else:
            self.worker.put(port.name, task)

    def _on_skeleton(self, port: str, topic: str, skeleton: BodySkeleton) -> None:
        self.worker.put(port, partial(self._handle, port, topic, skeleton), skeleton.id)

    def _handle(self, port: str, topic: str, message: Any) -> None:
        """Pass one message to the component and publish the results (on the worker thread)."""
        if not self.active:
            return
        for name, optional in self._optional.items():
            usable = name not in self._unusable
            self.component.set_expected(name, usable and self._node.count_publishers(optional) > 0)
        self._outputs.tell_subscribed()
        if hasattr(message, "header"):
            self._check_stamp(topic, header_ns(message.header))
        self.publish(self.component.handle(port, message))
        for warning in self.component.report.drain_warnings():
            self._warn(f"{topic}: {warning}")

    def _check_stamp(self, topic: str, stamp: int) -> None:
        self._last_stamp = stamp
        now = self._node.get_clock().now().nanoseconds
        if stamp == 0:
            self.component.counters["stamps of zero"] += 1
            self._warn_once(
                f"{topic} has stamps of zero: results have them too, and latency means nothing; set the stamp"
            )
        elif stamp > now + MAX_STAMP_LEAD_NS:
            self.component.counters["stamps from the future"] += 1
            self._warn_once(
                f"{topic} has stamps from the future; set use_sim_time if a bag is played, or synchronise the clocks"
            )

    def publish(self, outputs: Output) -> None:
        """Publish the component's results unless the session has ended meanwhile."""
        for name, message in outputs:
            with self._publishing:
                if not self.active:
                    return
                self._outputs.publish(name, message)
            if message is None:
                continue
            self._record_published(self.component.find_output(name), message)

    def _record_published(self, port: Port, message: Any) -> None:
        self._diagnostics.count_message(port.name)
        if port.name in _PEOPLE_FIELDS:
            self._diagnostics.people = len(getattr(message, _PEOPLE_FIELDS[port.name]))
        if hasattr(message, "header"):
            age = self._node.get_clock().now().nanoseconds - header_ns(message.header)
            self._diagnostics.record_latency(age * 1e-9)

    def _on_task_error(self, error: Exception) -> None:
        if not self.active or not self._node.context.ok():
            return
        where = traceback.extract_tb(error.__traceback__)[-1]
        reason = " ".join(str(error).split())
        text = f"a message failed: {type(error).__name__}: {reason} ({where.filename}:{where.lineno})"
        self._diagnostics.record_failure(text)
        self._node.get_logger().error(text, throttle_duration_sec=LOG_INTERVAL_S)


def _resolve_topic(node: Node, topic: str) -> str:
    """Return the topic's full name after remapping; InputError if the name is not valid."""
    try:
        return str(node.resolve_topic_name(topic))
    except (RuntimeError, ValueError, NameValidationException) as error:
        raise InputError(f"{topic!r} is not a topic name: {' '.join(str(error).split())}") from error


@cache
def _background_executor() -> ThreadPoolExecutor:
    """Return the two threads for the slow work of all components of this process, one long and one short task."""
    return ThreadPoolExecutor(2, thread_name_prefix="background")
