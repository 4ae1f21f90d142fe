# SPDX-License-Identifier: Apache-2.0
"""From a topic as it was written to CDR messages of the types that are known here."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, cached_property
from typing import Any

from rosbags.typesys.store import Typestore

from flowing_puppet_ros.bag.foreign.foxglove import find_schema
from flowing_puppet_ros.bag.foreign.payloads import make_decoder
from flowing_puppet_ros.bag.foreign.ros_types import is_written_as, make_source_store, normalise_type
from flowing_puppet_ros.bag.storage.compression import ZSTD_MAGIC, decompress_message
from flowing_puppet_ros.bag.storage.stored_file import StoredTopic
from flowing_puppet_ros.stream.messages.message_types import MessageFactory

NO_MESSAGE = b""
"""What stands for a message that cannot be converted: no message has these bytes."""


class Converter:
    """Converts the messages of one topic; `type` is the ROS 2 type that they have afterwards.

    `definition` is the text of the type in the file, for types that are not known here.

    The topic's own definition is read with its first message, so topics that nobody reads cost nothing.
    """

    def __init__(self, topic: StoredTopic, store: Typestore, factory: MessageFactory) -> None:
        """Convert to the types in `store`, whose messages `factory` makes."""
        self._topic = topic
        self._store = store
        self._factory = factory
        self._schema = find_schema(topic.type)
        self.type = self._schema.type if self._schema else normalise_type(topic.type)
        as_written = topic.encoding == "cdr" and topic.schema_encoding == "ros2msg" and not self._schema
        self.definition = topic.schema.decode("utf8", "replace") if as_written else ""

    def convert(self, raw: bytes) -> bytes:
        """Return the message in CDR, or NO_MESSAGE; of a type that is not known here as it is."""
        try:
            if raw.startswith(ZSTD_MAGIC):  # no encapsulation of CDR begins so: rosbag2 compressed the message
                raw = decompress_message(raw)
            return raw if self._plan is None else self._plan(raw)
        except Exception:  # wrong bytes make the libraries raise anything
            return NO_MESSAGE

    @cached_property
    def _plan(self) -> Callable[[bytes], bytes] | None:
        """What is done with each message; None if it is CDR that is read as it is."""
        try:
            return self._make_plan()
        except Exception:  # definitions by others make the libraries raise anything
            return lambda raw: NO_MESSAGE

    def _make_plan(self) -> Callable[[bytes], bytes] | None:
        topic = self._topic
        if self._schema is not None:
            decode, build = make_decoder(topic, self._store), self._schema.build
            return lambda raw: self._serialise(build(self._factory, decode(raw)))
        if self.type not in self._store.fielddefs or topic.encoding not in ("cdr", "ros1"):
            return None
        if topic.encoding == "cdr" and is_written_as(topic, _write_definition(self._store, self.type)):
            return None
        source, own_type = make_source_store(topic), normalise_type(topic.type, rename=False)
        if source is None or _is_same(source, self._store, own_type, self.type):
            if topic.encoding == "cdr":
                return None
            return lambda raw: bytes(self._store.ros1_to_cdr(raw, self.type))
        # Loaded here, as below: it brings what writes all kinds of bags, and few recordings need it.
        from rosbags.convert.converter import migrate_message

        cache: dict[str, object] = {}
        decode = make_decoder(topic, self._store)
        return lambda raw: self._serialise(
            migrate_message(source, self._store, own_type, self.type, cache, decode(raw))
        )

    def _serialise(self, message: Any) -> bytes:
        return bytes(self._store.serialize_cdr(message, self.type))


@cache
def _write_definition(store: Typestore, kind: str) -> str:
    return str(store.generate_msgdef(kind, ros_version=2)[0])


def _is_same(source: Typestore, target: Typestore, own_type: str, kind: str) -> bool:
    """Return whether messages of two definitions have the same bytes, but for the header of ROS 1."""
    from rosbags.convert.converter import is_same_wireformat

    try:
        return bool(is_same_wireformat(source, target, own_type, kind))
    except KeyError:  # the recorder left out a part of the definition
        return True
