# SPDX-License-Identifier: Apache-2.0
"""Names and definitions of ROS types as files have them."""

from __future__ import annotations

import re
from functools import lru_cache

from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from flowing_puppet_ros.bag.storage.stored_file import StoredTopic

_RENAMED = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}
"""Types of ROS 1 with another name in ROS 2."""
_RULE = "=" * 80 + "\n"


def normalise_type(name: str, rename: bool = True) -> str:
    """Return `package/msg/Name` for the ways in which types are written, as it is for other names.

    These are `package/Name`, `package::msg::Name`, `package::msg::dds_::Name_` and `package.msg.Name`. With `rename`,
    the type of ROS 2 is returned for that of ROS 1.
    """
    separator = r"::|[/.]" if ".msg." in name else r"::|/"
    parts = [part for part in re.split(separator, name.strip()) if part not in ("msg", "dds_")]
    if len(parts) != 2 or not all(re.fullmatch(r"\w+", part) for part in parts):
        return name
    normal = f"{parts[0]}/msg/{parts[1].removesuffix('_')}"
    return _RENAMED.get(normal, normal) if rename else normal


def is_written_as(topic: StoredTopic, text: str) -> bool:
    """Return whether a topic's definition is `text` but for comments, spaces and the order of the types in it.

    That is quicker to see than a definition is to parse; others may be the same too.
    """
    try:
        return topic.schema_encoding == "ros2msg" and _sections(topic.schema.decode()) == _sections(text)
    except UnicodeDecodeError:
        return False


def _sections(text: str) -> list[list[str]]:
    bare = [" ".join(line.partition("#")[0].split()) for line in text.splitlines()]
    first, *others = "\n".join(line for line in bare if line).split(_RULE)
    return [first.split("\n"), *sorted(section.split("\n") for section in others)]


def make_source_store(topic: StoredTopic) -> Typestore | None:
    """Return the types in the definition that the file has for a topic; None if it has none that is readable."""
    return _parse_definition(normalise_type(topic.type, rename=False), topic.schema_encoding, topic.schema)


@lru_cache(maxsize=256)
def _parse_definition(kind: str, encoding: str, schema: bytes) -> Typestore | None:
    try:
        text = schema.decode()
        if encoding in ("ros1msg", "ros2msg") and text.strip():
            types = get_types_from_msg(text, kind)
        elif encoding in ("ros2idl", "omgidl"):
            types = {}
            for part in text.split(_RULE) if _RULE in text else [text]:
                types.update(get_types_from_idl(part.split("\n", 1)[1] if part.startswith("IDL: ") else part))
        else:
            return None
        if encoding == "ros1msg":
            known = get_typestore(Stores.ROS1_NOETIC).fielddefs
            types = {name: known[name] for name in ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
                     if name in known} | types  # fmt: skip
        store = get_typestore(Stores.EMPTY)
        store.register(types)
    except Exception:  # definitions by others make the library raise anything
        return None
    return store if kind in store.fielddefs else None
