# SPDX-License-Identifier: Apache-2.0
"""Hear the topics of a running ROS graph for a while, without deserialising them."""

from __future__ import annotations

import time
from collections import Counter
from functools import partial

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from flowing_puppet_ros.bag.reader import Record, Topic
from flowing_puppet_ros.bag.typestore import typestore
from flowing_puppet_ros.doctor.live import LiveRecording, Publisher
from flowing_puppet_ros.node.factory import is_installed, message_type

MAX_BYTES = 400_000_000
"""Bytes of messages that are kept; later ones are only counted."""
DISCOVERY_S = 2.0
"""Seconds until the publishers of a graph are known."""
_POLL_S = 0.02


class _Listener:
    """The subscriptions and what came over them."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._bytes = 0
        self.publishers: dict[str, list[Publisher]] = {}
        self.counts: Counter[str] = Counter()
        self.records: list[Record] = []

    def subscribe(self) -> None:
        """Subscribe to the topics that are new since the last call and whose type is read here."""
        for name, types in self._node.get_topic_names_and_types():
            infos = self._node.get_publishers_info_by_topic(name)
            if not infos or name in self.publishers:
                continue
            self.publishers[name] = [
                Publisher(
                    f"{info.node_namespace.rstrip('/')}/{info.node_name}",
                    info.topic_type,
                    info.qos_profile.reliability.name.lower(),
                    info.qos_profile.durability.name.lower(),
                )
                for info in infos
            ]
            kind = infos[0].topic_type or types[0]
            if kind in typestore().fielddefs and is_installed(kind):
                latched = all(info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for info in infos)
                qos = QoSProfile(
                    depth=100,
                    reliability=ReliabilityPolicy.BEST_EFFORT if not latched else ReliabilityPolicy.RELIABLE,
                    durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
                )
                self._node.create_subscription(
                    message_type(kind), name, partial(self._on_message, name, kind), qos, raw=True
                )

    def _on_message(self, name: str, kind: str, raw: bytes) -> None:
        self.counts[name] += 1
        self._bytes += len(raw)
        if self._bytes <= MAX_BYTES:
            self.records.append(Record(name, kind, time.time_ns(), bytes(raw)))


def listen(seconds: float) -> LiveRecording:
    """Return what is published in the running graph, and the messages of `seconds`, of the types that are read here."""
    context = rclpy.Context()
    rclpy.init(context=context)
    try:
        node = Node("flowing_puppet_doctor", context=context, start_parameter_services=False, enable_rosout=False)
        executor = rclpy.executors.SingleThreadedExecutor(context=context)
        executor.add_node(node)
        listener = _Listener(node)
        until = time.monotonic() + DISCOVERY_S + seconds
        while time.monotonic() < until:
            listener.subscribe()
            executor.spin_once(timeout_sec=_POLL_S)
        executor.shutdown()
        node.destroy_node()
    finally:
        rclpy.try_shutdown(context=context)
    details = {
        name: Topic(publishers[0].type, listener.counts[name], ()) for name, publishers in listener.publishers.items()
    }
    return LiveRecording(seconds, details, listener.publishers, listener.records)
