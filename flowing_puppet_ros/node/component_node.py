# SPDX-License-Identifier: Apache-2.0
"""The node around a stream component: topics, parameters, a worker thread, diagnostics, reset."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.qos_overriding_options import QoSOverridingOptions
from std_srvs.srv import Trigger

from flowing_puppet_ros.node.diagnostics import Diagnostics
from flowing_puppet_ros.node.factory import RosMessageFactory, message_type
from flowing_puppet_ros.node.parameters import declare
from flowing_puppet_ros.node.registry import COMPONENTS, NodeSettings
from flowing_puppet_ros.node.worker import Worker
from flowing_puppet_ros.stream.component import COMPRESSED_IMAGE, Component, Port
from flowing_puppet_ros.stream.images import compress
from flowing_puppet_ros.stream.messages import header_ns

C = TypeVar("C", bound=Component)
QUIET_SECONDS = 5.0
"""Shortest time between two log lines about the same trouble."""
_SUBSCRIPTION_QOS = {
    "sensor": qos_profile_sensor_data,
    "reliable": QoSProfile(depth=10),
    "latched": QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL),
}
_PUBLISHER_QOS = {
    "reliable": QoSProfile(depth=10),
    "latched": QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
}


class ComponentNode[C: Component](Node):
    """Runs one component on live topics.

    Callbacks only put messages in line; the worker thread hands them to the component in order of arrival and
    publishes what comes out. Whatever a message does, the node goes on.
    """

    def __init__(self, name: str) -> None:
        """Declare the parameters, load the component, open the topics; InputError when a parameter is unusable."""
        super().__init__(name)
        settings = declare(self, COMPONENTS[name].settings_type)
        own = declare(self, NodeSettings)
        self.component: C = COMPONENTS[name](settings, RosMessageFactory())  # type: ignore[call-arg, arg-type, assignment]
        self.worker = Worker(own.queue, self._failed)
        self._diagnostics = Diagnostics(self.get_fully_qualified_name(), name)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._reported = self._steady.now()
        outputs = self.component.outputs
        self._outputs = {port.name: self._open_output(port) for port in outputs if not port.per_person}
        self._diagnostics_publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 1)
        self._optional = [port for port in self.component.inputs if port.optional]
        self._lazy = [port for port in self.component.outputs if port.lazy]
        for port in self.component.inputs:
            self._subscribe(port)
        self.create_service(Trigger, "~/reset", self._reset_requested)
        self.create_timer(1.0, self._report, clock=self._steady)
        backward = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=True)
        # The handle keeps the callback registered.
        self._jump_handle = self.get_clock().create_jump_callback(backward, post_callback=self._time_jumped)

    def destroy_node(self) -> None:
        """Let the running task end, then take the node down."""
        self.worker.stop()
        super().destroy_node()

    def _subscribe(self, port: Port) -> None:
        self._subscription(message_type(port.type), port.name, port)
        if port.compressed:
            self._subscription(message_type(COMPRESSED_IMAGE), self._compressed(port), port)

    def _subscription(self, kind: Any, topic: str, port: Port) -> None:
        received, qos = partial(self._received, port.name), _SUBSCRIPTION_QOS[port.qos]
        options = QoSOverridingOptions.with_default_policies()
        self.create_subscription(kind, topic, received, qos, qos_overriding_options=options)

    def _open_output(self, port: Port) -> list[tuple[Publisher, Callable[[Any], Any]]]:
        """Return the publishers of a port, each with what makes its message out of the component's."""
        made: list[tuple[Publisher, Callable[[Any], Any]]]
        made = [(self._publisher(message_type(port.type), port.name, port.qos), _same)]
        if port.compressed:
            compressed = self._publisher(message_type(COMPRESSED_IMAGE), self._compressed(port), port.qos)
            made.append((compressed, partial(compress, self.component.factory)))
        return made

    def _compressed(self, port: Port) -> str:
        """Return the topic of a port's compressed images: it follows the port when that is remapped."""
        return f"{self.resolve_topic_name(port.name)}/compressed"

    def _publisher(self, kind: Any, topic: str, qos: str) -> Publisher:
        options = QoSOverridingOptions.with_default_policies()
        return self.create_publisher(kind, topic, _PUBLISHER_QOS[qos], qos_overriding_options=options)

    def _received(self, port: str, message: Any) -> None:
        self._diagnostics.passed(port)
        self.worker.put(port, partial(self._handle, port, message))

    def _handle(self, port: str, message: Any) -> None:
        """Hand one message to the component and publish what comes out (on the worker thread)."""
        for optional in self._optional:
            topic = self.resolve_topic_name(optional.name)
            self.component.expects(optional.name, self.count_publishers(topic) > 0)
        for lazy in self._lazy:
            listened = any(publisher.get_subscription_count() for publisher, _ in self._outputs[lazy.name])
            self.component.wants(lazy.name, listened)
        for name, output in self.component.handle(port, message):
            self._publish(name, output)
        for warning in self.component.drain_warnings():
            self.get_logger().warning(warning)

    def _publish(self, name: str, message: Any) -> None:
        """Publish on an output; that of a person is opened at the first message and closed at None."""
        if message is None:
            for publisher, _ in self._outputs.pop(name, []):
                self.destroy_publisher(publisher)
            return
        port = self.component.output(name)
        if name not in self._outputs:
            self._outputs[name] = self._open_output(replace(port, name=name))
        extra = len(self._outputs[name]) > 1
        for publisher, converted in self._outputs[name]:
            if not extra or publisher.get_subscription_count():
                publisher.publish(converted(message))
        self._diagnostics.passed(port.name)
        if hasattr(message, "header"):
            self._diagnostics.took((self.get_clock().now().nanoseconds - header_ns(message.header)) * 1e-9)

    def _failed(self, error: Exception) -> None:
        if not self.context.ok():
            return
        self._diagnostics.failed()
        where = traceback.extract_tb(error.__traceback__)[-1]
        reason = " ".join(str(error).split())
        text = f"a message failed: {type(error).__name__}: {reason} ({where.filename}:{where.lineno})"
        self.get_logger().error(text, throttle_duration_sec=QUIET_SECONDS)

    def _report(self) -> None:
        now = self._steady.now()
        seconds, self._reported = (now - self._reported).nanoseconds * 1e-9, now
        stamp = self.get_clock().now().to_msg()
        report = self._diagnostics.report(stamp, seconds, dict(self.component.counters), dict(self.worker.dropped))
        self._diagnostics_publisher.publish(report)

    def _reset_requested(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._reset()
        response.success = True
        response.message = "the next message starts anew"
        return response

    def _time_jumped(self, jump: TimeJump) -> None:
        self.get_logger().warning("the time jumped back: starting anew")
        self._reset()

    def _reset(self) -> None:
        self.worker.clear()
        self.worker.call(self.component.reset)


def _same(message: Any) -> Any:
    return message


def make_node(name: str) -> ComponentNode[Any]:
    """Return the node that runs the component of this name."""
    return ComponentNode(name)
