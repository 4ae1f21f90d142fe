# SPDX-License-Identifier: Apache-2.0
"""The base of all stream components: ports, settings, counters, and messages in and out.

A live node wraps one component and so does the bag replay. A component converts messages, keeps what must wait for a
partner, runs one algorithm object and returns the messages to publish. It knows no clock and no middleware, so the
same messages give the same results live and replayed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any, ClassVar

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.ids import make_public_id
from flowing_puppet_ros.reporting import Report
from flowing_puppet_ros.settings import Settings
from flowing_puppet_ros.stream.messages.message_types import MessageFactory

Output = list[tuple[str, Any]]
"""Names of output ports, or of one person's topic (`Port.person_topic`), each with a message; None closes the topic."""
_ID = "{id}"

COMPRESSED, COMPRESSED_DEPTH = "compressed", "compressedDepth"  # transports of images


def base_topic(topic: str) -> str:
    """Return the image topic that `topic` belongs to: without the suffix of an image transport, if it has one."""
    for transport in (COMPRESSED, COMPRESSED_DEPTH):
        topic = topic.removesuffix(f"/{transport}")
    return topic


def is_compressed_depth_topic(topic: str) -> bool:
    """Return whether a topic carries compressed depth images."""
    return topic.endswith(f"/{COMPRESSED_DEPTH}")


@dataclass(frozen=True, slots=True)
class Port:
    """One topic of a component: its name relative to the node's namespace, or global when it starts with a slash.

    `qos`: "sensor" (best effort, as sensors publish), "reliable" or "latched" (transient local).
    `lazy`: an output that is made only while it has subscribers.
    `transport`: the image also travels as CompressedImage on `<name>/<transport>`; COMPRESSED or, for an input,
    COMPRESSED_DEPTH; empty when it does not.
    `optional`: an input that the component works without, or an output whose message package a machine may lack.
    `alternatives`: other types of message that an input understands.
    `recorded`: a replay writes this output into its bag; False for what is too large.

    An output with `{id}` in its name is one topic per person. The component puts `port.person_topic(id)` beside each
    message. The caller opens that topic at its first message and closes it at a message that is None: the person is
    lost. Such a port is never lazy and has no transport.
    """

    name: str
    type: str
    qos: str = "reliable"
    lazy: bool = False
    transport: str = ""
    optional: bool = False
    recorded: bool = True
    alternatives: tuple[str, ...] = ()

    def accepts(self, type_name: str) -> bool:
        """Return whether this input understands a type, also under the name of a renamed package (zed_interfaces)."""
        names = {other.rpartition("/")[2] for other in self.alternatives}
        return type_name == self.type or type_name.rpartition("/")[2] in names

    @property
    def per_person(self) -> bool:
        """Whether every person has a topic of their own."""
        return _ID in self.name

    def person_topic(self, identity: str) -> str:
        """Return the name of one person's topic."""
        return self.name.replace(_ID, identity)

    def covers(self, name: str) -> bool:
        """Return whether `name` is this port's or, for a port per person, that of one person's topic."""
        before, placeholder, after = self.name.partition(_ID)
        if not placeholder:
            return name == self.name
        identity = name[len(before) : len(name) - len(after)]
        return bool(identity) and "/" not in identity and name == self.person_topic(identity)


class Component[S: Settings]:
    """Base of the stream components; S is the type of the settings."""

    settings_type: ClassVar[type[Settings]]
    fixed: ClassVar[frozenset[str]] = frozenset()
    """Settings that cannot change after the node was started."""
    hot_settings: ClassVar[frozenset[str]] = frozenset()
    """Settings that `reconfigure` changes while the component runs; a change of any other needs a new component."""
    node: str = ""
    """Fully qualified name of the node, from which the ids of its people follow; empty where there is no node."""
    background: Executor | None = None
    """Executor of slow work in a live node; None: all work is done at once, as in a replay."""
    min_queue: ClassVar[int] = 1
    """Messages of each input that a live node keeps at least; more where the component itself drops old ones."""
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]

    def __init__(self, settings: S, factory: MessageFactory) -> None:
        """Make a component that creates its messages with `factory`; its lazy outputs have no subscribers yet."""
        self.settings = settings
        self.factory = factory
        self.report = Report()
        self.dropped: Counter[str] = Counter()
        """Messages of each input that were dropped for newer ones."""
        self.is_behind: Callable[[], bool] = _never
        """Whether messages wait already; a live node sets it, a replay is never behind."""
        self._expected: set[str] = set()
        self._subscribed: set[str] = set()

    def handle(self, port: str, message: Any) -> Output:
        """Process one message and return the messages that are now ready, in the order of publication.

        A message that cannot be used (an unknown encoding, an empty cloud) is counted under `unusable` and adds one
        sentence to the `report` for every new reason; the component continues.
        """
        self.counters[f"received {port}"] += 1
        return self._try_process(port, message)

    def flush(self) -> Output:
        """Return the messages for what still waits for a partner at the end of the input."""
        return []

    def describe_rejected(self) -> dict[str, Any] | None:
        """Return the last cloud's `stamp_ns` and the `candidates` that are no people, for JSON; None without clouds."""
        return None

    def warm_up(self) -> None:
        """Load and compile what the first message would otherwise wait for; the component's state does not change."""

    def reset(self) -> None:
        """Clear the state: the next message starts a new recording."""

    def reconfigure(self, settings: S) -> None:
        """Continue with settings that differ from the present ones in `hot_settings` only."""
        self.settings = settings

    def publish_id(self, own: str) -> str:
        """Return the id under which a person is published that the component itself calls `own`."""
        return make_public_id(self.node, own) if self.node else own

    def set_expected(self, port: str, expected: bool) -> None:
        """Set whether an optional input has publishers, so that the component knows what to wait for."""
        self._switch(self._expected, self.inputs, port, expected)

    def set_subscribed(self, port: str, subscribed: bool) -> None:
        """Set whether a lazy output has subscribers."""
        self._switch(self._subscribed, self.outputs, port, subscribed)

    def find_output(self, name: str) -> Port:
        """Return the output port of `name`, the name beside a message; KeyError when there is none."""
        for port in self.outputs:
            if port.covers(name):
                return port
        raise KeyError(name)

    @property
    def counters(self) -> Counter[str]:
        """What was counted since the start, by name."""
        return self.report.counters

    def _process(self, port: str, message: Any) -> Output:
        raise NotImplementedError

    def _try_process(self, port: str, message: Any) -> Output:
        try:
            return self._process(port, message)
        except InputError as error:
            self.report.count_unusable(error)
            return []

    @staticmethod
    def _switch(switches: set[str], ports: Iterable[Port], port: str, on: bool) -> None:
        if port not in {item.name for item in ports}:
            raise ValueError(f"no port {port!r}")
        (switches.add if on else switches.discard)(port)


def _never() -> bool:
    return False
