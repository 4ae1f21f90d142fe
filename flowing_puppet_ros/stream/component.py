# SPDX-License-Identifier: Apache-2.0
"""What every stream component is: ports, settings, counters, and messages in and out.

A live node wraps one component and so does the bag replay: a component converts messages, keeps what it must wait
for, runs one algorithm object and returns the messages to publish. It knows no clock and no middleware, so the same
messages give the same answers live and replayed.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any, ClassVar

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.settings import Settings
from flowing_puppet_ros.stream.messages.message_types import MessageFactory

Output = list[tuple[str, Any]]
"""Names of output ports, or of a person's topic of one (`Port.of`), each with a message; None closes such a topic."""
_ID = "{id}"
MAX_WARNINGS = 100
"""Different sentences that a component logs in its life; what can be wrong with hostile input has no end."""

COMPRESSED, COMPRESSED_DEPTH = "compressed", "compressedDepth"  # transports of images


def base_topic(topic: str) -> str:
    """Return the topic of an image that travels on `topic`: without the word of a transport, where there is one."""
    for transport in (COMPRESSED, COMPRESSED_DEPTH):
        topic = topic.removesuffix(f"/{transport}")
    return topic


def sends_depth(topic: str) -> bool:
    """Whether a topic is that of the transport of depth images."""
    return topic.endswith(f"/{COMPRESSED_DEPTH}")


@dataclass(frozen=True, slots=True)
class Port:
    """One topic of a component: its name relative to the node's namespace, or global when it starts with a slash.

    qos: "sensor" (best effort, what sensors publish), "reliable" or "latched" (transient local).
    lazy: worth making only when somebody listens. transport: the image also travels as CompressedImage on
    `<name>/<transport>`, COMPRESSED or, an input, COMPRESSED_DEPTH; empty when it does not. optional: an input the
    component works without.

    An output with `{id}` in its name is one topic a person. The component puts `port.of(id)` beside each message; who
    runs the component opens that topic at its first message and closes it at a message that is None, which says that
    the person is lost. Such a port is neither lazy nor has it a transport.
    """

    name: str
    type: str
    qos: str = "reliable"
    lazy: bool = False
    transport: str = ""
    optional: bool = False

    @property
    def per_person(self) -> bool:
        """Whether this is a topic for every person."""
        return _ID in self.name

    def of(self, identity: str) -> str:
        """Return the name of a person's topic."""
        return self.name.replace(_ID, identity)

    def covers(self, name: str) -> bool:
        """Whether `name` is this port's, or that of one of its people."""
        before, found, after = self.name.partition(_ID)
        if not found:
            return name == self.name
        identity = name[len(before) : len(name) - len(after)]
        return bool(identity) and "/" not in identity and name == self.of(identity)


class Component:
    """Base of the stream components."""

    settings_type: ClassVar[type[Settings]]
    fixed: ClassVar[frozenset[str]] = frozenset()
    """Settings that stay as they were when the node was started."""
    hot_settings: ClassVar[frozenset[str]] = frozenset()
    """Settings that `adopt` changes; a change of any other needs a new component."""
    background: Executor | None = None
    """Where a live node lets slow work run beside the messages; None: all work is done at once, as in a replay."""
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]

    def __init__(self, settings: Settings, factory: MessageFactory) -> None:
        """Make a component whose messages `factory` makes; nobody listens to its lazy outputs yet."""
        self.settings = settings
        self.factory = factory
        self.counters: Counter[str] = Counter()
        self.warnings: list[str] = []
        self._warned: set[str] = set()
        self._expected: set[str] = set()
        self._wanted: set[str] = set()

    def handle(self, port: str, message: Any) -> Output:
        """Take one message and return the messages that it made ready, in the order they should be published.

        A message that cannot be used (an unknown encoding, an empty cloud) is counted under `unusable` and leaves
        one sentence in `warnings` for every new reason; the run goes on.
        """
        self.counters[f"received {port}"] += 1
        return self._guarded(port, message)

    def flush(self) -> Output:
        """Return what was still waiting for a partner when the input ended."""
        return []

    def warm_up(self) -> None:
        """Load and compile what the first message would wait for; nothing else of the component changes."""

    def reset(self) -> None:
        """Forget the past: the next message starts a new recording."""

    def reconfigure(self, settings: Settings) -> None:
        """Go on with settings that differ from the present ones in `adoptable` ones only."""
        self.settings = settings

    def set_expected(self, port: str, expected: bool) -> None:
        """Say whether anybody publishes on an optional input, so that the component knows what to wait for."""
        self._switch(self._expected, self.inputs, port, expected)

    def set_subscribed(self, port: str, wanted: bool) -> None:
        """Say whether anybody listens to a lazy output."""
        self._switch(self._wanted, self.outputs, port, wanted)

    def output(self, name: str) -> Port:
        """Return the output port that `name`, as it stands beside a message, belongs to; KeyError when none does."""
        for port in self.outputs:
            if port.covers(name):
                return port
        raise KeyError(name)

    def drain_warnings(self) -> list[str]:
        """Return the sentences to log that arose since the last call."""
        warnings, self.warnings = self.warnings, []
        return warnings

    def _process(self, port: str, message: Any) -> Output:
        raise NotImplementedError

    def _guarded(self, port: str, message: Any) -> Output:
        try:
            return self._process(port, message)
        except InputError as error:
            self._unusable(error)
            return []

    def _unusable(self, error: InputError) -> None:
        self._warn(str(error))
        self.counters["unusable"] += 1

    def _warn(self, sentence: str) -> None:
        """Log `sentence` once in the component's life; sentences that differ in their numbers only are the same."""
        reason = re.sub(r"[0-9.]+", "#", sentence)
        if reason not in self._warned and len(self._warned) < MAX_WARNINGS:
            self._warned.add(reason)
            self.warnings.append(sentence)

    @staticmethod
    def _switch(switches: set[str], ports: Iterable[Port], port: str, on: bool) -> None:
        if port not in {item.name for item in ports}:
            raise ValueError(f"no port {port!r}")
        (switches.add if on else switches.discard)(port)
