# SPDX-License-Identifier: Apache-2.0
"""Messages in CDR, ROS 1's encoding, JSON or protobuf to objects whose fields are attributes."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
from rosbags.typesys.store import Typestore

from flowing_puppet_ros.arrays import U8
from flowing_puppet_ros.bag.foreign.ros_types import make_source_store, normalise_type
from flowing_puppet_ros.bag.storage.stored_file import StoredTopic

Decoder = Callable[[bytes], Any]


def make_decoder(topic: StoredTopic, known: Typestore) -> Decoder:
    """Return the function from a message's bytes to an object; ValueError without a definition that it needs.

    Databases of older recorders have no definitions: of ROS 2 messages those that are `known` are taken.
    """
    if topic.encoding == "json":
        return lambda raw: json.loads(raw, object_hook=lambda fields: SimpleNamespace(**fields))
    if topic.encoding == "protobuf":
        return _make_protobuf_decoder(topic)
    store, kind = make_source_store(topic), normalise_type(topic.type, rename=False)
    if store is None and topic.encoding == "cdr" and kind in known.fielddefs:
        store = known
    if store is None:
        raise ValueError(f"there is no definition of {topic.type}")
    if topic.encoding == "ros1":
        return lambda raw: store.deserialize_ros1(raw, kind)
    return lambda raw: store.deserialize_cdr(raw, kind)


def _make_protobuf_decoder(topic: StoredTopic) -> Decoder:
    from google.protobuf import descriptor_pb2, descriptor_pool

    pool = descriptor_pool.DescriptorPool()
    waiting = list(descriptor_pb2.FileDescriptorSet.FromString(topic.schema).file)
    # The files of a set may be in any order, but a pool wants those first that others import.
    while waiting:
        names = {file.name for file in waiting}
        ready = [file for file in waiting if not names & set(file.dependency)]
        if not ready:
            raise ValueError("the definitions import one another in a circle")
        for file in ready:
            pool.Add(file)
        waiting = [file for file in waiting if names & set(file.dependency)]
    kind = make_protobuf_class(pool.FindMessageTypeByName(topic.type))
    return lambda raw: kind.FromString(raw)


def make_protobuf_class(descriptor: Any) -> Any:
    """Return the class of a protobuf message; Ubuntu 24.04 has a version of protobuf with another name for it."""
    from google.protobuf import message_factory

    if hasattr(message_factory, "GetMessageClass"):
        return message_factory.GetMessageClass(descriptor)
    return message_factory.MessageFactory(descriptor.file.pool).GetPrototype(descriptor)


def read_bytes(value: Any) -> U8:
    """Return a field of bytes (N,), which JSON has as base64."""
    if isinstance(value, str):
        value = base64.b64decode(value)
    return value.view(np.uint8) if isinstance(value, np.ndarray) else np.frombuffer(bytes(value), np.uint8)
