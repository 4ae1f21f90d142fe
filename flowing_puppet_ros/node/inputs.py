# SPDX-License-Identifier: Apache-2.0
"""What is subscribed to, where that depends on who publishes: transports of images, types of detections, bodies."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from copy import copy
from functools import partial
from typing import Any

from rclpy.exceptions import NameValidationException
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.node.factory import is_installed, message_type
from flowing_puppet_ros.stream.component import Port
from flowing_puppet_ros.stream.messages.detections import BodySkeleton, skeleton_topic
from flowing_puppet_ros.stream.messages.message_types import SKELETON_2D

AUTO, RAW, COMPRESSED = "auto", "raw", "compressed"
CHECK_INTERVAL_S = 0.25
"""Seconds between two looks at who publishes."""
MAX_BODIES = 100
"""Maximum bodies in a list whose skeletons are subscribed to."""


class TransportChoice:
    """The transport of one image, raw or compressed, by what is published; never both: cameras encode on demand.

    `setting` is AUTO, RAW or COMPRESSED. With AUTO the choice stays while somebody publishes what was chosen. When
    nobody does, raw images come first, then compressed ones. Publishers are discovered one after the other: a change
    needs two updates in a row.
    """

    def __init__(self, setting: str = AUTO) -> None:
        """Start with raw images, unless the setting says otherwise."""
        self.chosen = COMPRESSED if setting == COMPRESSED else RAW
        self.setting = setting
        self._used = False
        self._wanted = self.chosen

    def update(self, raw: int, compressed: int) -> str:
        """Return the transport to subscribe to, given the numbers of `raw` and `compressed` publishers."""
        if self.setting != AUTO:
            self.chosen = self.setting
            return self.chosen
        publishers = {RAW: raw, COMPRESSED: compressed}
        before, self._wanted = self._wanted, self._find_wanted(publishers)
        if before == self._wanted:
            self.chosen = self._wanted
        self._used = self._wanted == self.chosen and publishers[self.chosen] > 0
        return self.chosen

    def _find_wanted(self, publishers: dict[str, int]) -> str:
        if self._used and publishers[self.chosen]:
            return self.chosen
        return next((transport for transport in (RAW, COMPRESSED) if publishers[transport]), self.chosen)


def check_no_loop(topics: Mapping[str, str], inputs: Iterable[Port], outputs: Collection[str]) -> None:
    """Raise an InputError if an input for others' results is an output of this node; `topics` are by name of input."""
    for port in inputs:
        if port.alternatives and topics[port.name] in outputs:
            raise InputError(
                f"{port.name} is {topics[port.name]}, which this node itself publishes: name another topic there"
            )


def choose_type(published: Collection[str], port: Port, present: str) -> str:
    """Return the type to subscribe to on an input that understands several, given those `published` on its topic.

    It stays the `present` one while somebody publishes that, or nobody publishes anything. InputError if none of the
    published types is understood, or installed here.
    """
    if present in published or not published:
        return present
    understood = [kind for kind in sorted(published) if port.accepts(kind)]
    if not understood:
        known = ", ".join((port.type, *port.alternatives))
        raise InputError(
            f"{', '.join(sorted(published))} is published, which is not understood; understood are {known}"
        )
    if not is_installed(understood[0]):
        package = understood[0].partition("/")[0]
        raise InputError(
            f"{understood[0]} is published, but {package} is not installed: source a workspace that has it"
        )
    return understood[0]


class BodyTopics:
    """The subscriptions to the skeletons of the bodies that REP-155 lists, each on a topic of its own."""

    def __init__(
        self,
        node: Node,
        qos: QoSProfile,
        receive: Callable[[str, BodySkeleton], None],
        warn: Callable[[str], None],
    ) -> None:
        """Subscribe to nothing yet; `receive` will get topic and skeleton, `warn` a sentence about an unusable id."""
        self._node = node
        self._qos = qos
        self._receive = receive
        self._warn = warn
        self._open: dict[str, Subscription] = {}

    def follow(self, listing: str, ids: Sequence[str]) -> None:
        """Subscribe to the skeletons of the bodies in a list, and no longer to those that nobody publishes."""
        wanted = {skeleton_topic(listing, identity): identity for identity in ids}
        for topic in self._open.keys() - wanted.keys():
            if not self._node.count_publishers(topic):
                self._node.destroy_subscription(self._open.pop(topic))
        for topic in sorted(wanted.keys() - self._open.keys())[: MAX_BODIES - len(self._open)]:
            receive = partial(self._on_message, topic, wanted[topic])
            try:
                self._open[topic] = self._node.create_subscription(
                    message_type(SKELETON_2D), topic, receive, copy(self._qos)
                )
            except (RuntimeError, ValueError, NameValidationException):
                self._warn(f"{listing}: a topic cannot be named after the id {wanted[topic]!r}")

    def close(self) -> None:
        """End all subscriptions."""
        while self._open:
            self._node.destroy_subscription(self._open.popitem()[1])

    def _on_message(self, topic: str, identity: str, message: Any) -> None:
        self._receive(topic, BodySkeleton(identity, message))
