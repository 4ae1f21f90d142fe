# SPDX-License-Identifier: Apache-2.0
"""The publishers of a component's outputs, those of single people included."""

from __future__ import annotations

from collections.abc import Callable, Collection
from copy import copy
from dataclasses import replace
from functools import partial
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from flowing_puppet_ros.node.factory import is_installed, message_type
from flowing_puppet_ros.stream.component import Component, Port
from flowing_puppet_ros.stream.messages.images import compress_image
from flowing_puppet_ros.stream.messages.message_types import COMPRESSED_IMAGE

_QOS = {
    "reliable": QoSProfile(depth=10),
    "latched": QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
}


class Outputs:
    """Publishes what a component returns; topics of a person open with the first message and close with `None`.

    An optional output whose message package is not installed is left out, and the subscribers it has in vain are told.
    Not safe for several threads at once.
    """

    def __init__(
        self, node: Node, component: Component[Any], on_incompatible_qos: Callable[[str, str, Any], None]
    ) -> None:
        """Open the outputs that do not belong to a person; `on_incompatible_qos` gets topic, "publisher" and event."""
        self._node = node
        self._component = component
        self._on_incompatible_qos = on_incompatible_qos
        self._lazy = [port for port in component.outputs if port.lazy]
        self._unavailable = [port for port in component.outputs if port.optional and not is_installed(port.type)]
        self._publishers: dict[str, list[tuple[Publisher, Callable[[Any], Any]]]] = {}
        try:
            for port in component.outputs:
                if not port.per_person and port not in self._unavailable:
                    self._publishers[port.name] = self._open(port)
        except Exception:
            self.close()
            raise

    def publish(self, name: str, message: Any) -> None:
        """Publish a message on the output `name`; `None` closes it."""
        if message is None:
            self._close(name)
            return
        if name not in self._publishers:
            self._publishers[name] = self._open(replace(self._component.find_output(name), name=name), person=True)
        publishers = self._publishers[name]
        for publisher, convert in publishers:
            if len(publishers) == 1 or publisher.get_subscription_count():
                publisher.publish(convert(message))

    def tell_subscribed(self) -> None:
        """Tell the component which of its lazy outputs somebody subscribes to."""
        for port in self._lazy:
            publishers = self._publishers.get(port.name, [])
            subscribed = any(publisher.get_subscription_count() for publisher, _ in publishers)
            self._component.set_subscribed(port.name, subscribed)

    def find_missing(self) -> list[str]:
        """Return a sentence for each topic that is subscribed to but needs a message package that is not installed."""
        missing = []
        for port in self._unavailable:
            topic, package = self._node.resolve_topic_name(port.name), port.type.partition("/")[0]
            if self._node.count_subscribers(topic):
                missing.append(
                    f"{topic} is not published, since {package} is not installed: install ros-jazzy-"
                    + package.replace("_", "-")
                )
        return missing

    def close_people(self) -> None:
        """Close the topics of all people."""
        self.close(kept=[port.name for port in self._component.outputs])

    def close(self, kept: Collection[str] = ()) -> None:
        """Close all outputs but those `kept`."""
        for name in set(self._publishers) - set(kept):
            self._close(name)

    def _close(self, name: str) -> None:
        for publisher, _ in self._publishers.pop(name, []):
            self._node.destroy_publisher(publisher)

    def _open(self, port: Port, person: bool = False) -> list[tuple[Publisher, Callable[[Any], Any]]]:
        """Return the publishers of a port, each with the conversion from the component's message to its own."""
        opened: list[tuple[Publisher, Callable[[Any], Any]]]
        opened = [(self._create_publisher(message_type(port.type), port.name, port.qos, person), _identity)]
        if port.transport:
            topic = transport_topic(self._node, port)
            compressed = self._create_publisher(message_type(COMPRESSED_IMAGE), topic, port.qos, person)
            opened.append((compressed, partial(compress_image, self._component.factory)))
        return opened

    def _create_publisher(self, kind: Any, topic: str, qos: str, person: bool) -> Publisher:
        name = self._node.resolve_topic_name(topic)
        # Overriding options are parameters; one set per person would accumulate without end.
        options = None if person else QoSOverridingOptions.with_default_policies()
        events = PublisherEventCallbacks(incompatible_qos=partial(self._on_incompatible_qos, name, "publisher"))
        return self._node.create_publisher(
            kind, topic, copy(_QOS[qos]), qos_overriding_options=options, event_callbacks=events
        )


def transport_topic(node: Node, port: Port) -> str:
    """Return the topic of a port's compressed images, which follows the port when that is remapped."""
    return f"{node.resolve_topic_name(port.name)}/{port.transport}"


def _identity(message: Any) -> Any:
    return message
