# SPDX-License-Identifier: Apache-2.0
"""The `rosbags` type store of ROS 2 Jazzy with this package's messages, and a factory of its message objects.

The message definitions are the `.msg` files of the interface packages in `interfaces/`; those of other packages are
taken from the recording itself. ROS is not needed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from flowing_puppet_ros.errors import InputError, PuppetError

_INTERFACES = Path(__file__).resolve().parents[1] / "interfaces"
_PACKAGES = ("flowing_puppet_msgs", "hri_msgs", "vision_msgs", "foxglove_msgs", "people_msgs")


def definition_files(package: str) -> tuple[Path, ...]:
    """Return the `.msg` files of an interface package that is part of this one, sorted by name."""
    files = tuple(sorted((_INTERFACES / package / "msg").glob("*.msg")))
    if not files:
        raise PuppetError(f"the message definitions {_INTERFACES / package}/msg are missing: reinstall the package")
    return files


@cache
def typestore() -> Typestore:
    """Return the store of all types that this package reads or writes (made once)."""
    store = get_typestore(Stores.ROS2_JAZZY)
    definitions: dict[str, Any] = {}
    for package in _PACKAGES:
        for path in definition_files(package):
            definitions.update(get_types_from_msg(path.read_text("utf8"), f"{package}/msg/{path.stem}"))
    store.register(definitions)
    return store


@lru_cache(maxsize=64)
def typestore_with(type_name: str, definition: str) -> Typestore:
    """Return the store that knows a type: `typestore()` or, for a foreign type, one with its definition too.

    `definition` is the text of a `.msg` file, with those of the types in it, as a recording keeps it. InputError if it
    is empty or cannot be understood.
    """
    if type_name in typestore().fielddefs:
        return typestore()
    if not definition:
        raise InputError(f"the type {type_name} is not known here, and the recording has no definition of it")
    store = get_typestore(Stores.ROS2_JAZZY)
    try:
        known = typestore().fielddefs
        store.register(known)
        added = get_types_from_msg(definition, type_name)
        store.register({name: fields for name, fields in added.items() if name not in known})
    except Exception as error:  # a wrong text makes the library raise anything
        raise InputError(f"the recording's definition of {type_name} cannot be understood") from error
    return store


class BagMessageFactory:
    """Makes `rosbags` messages; `node.factory` makes those of rclpy."""

    def __init__(self, store: Typestore | None = None) -> None:
        """Make messages of a store, by default that of this package."""
        self._store = store or typestore()
        self._kinds: dict[str, tuple[Any, dict[str, Callable[[Any], Any]]]] = {}

    def make(self, type_name: str, **values: Any) -> Any:
        """Make a message of type `package/msg/Name`; fields without a value are zero, empty or False."""
        kind, converters = self._kinds.get(type_name) or self._add_kind(type_name)
        if not values.keys() <= converters.keys():
            wrong = next(name for name in values if name not in converters)
            raise TypeError(f"{type_name} has no field {wrong!r}")
        return kind(*[convert(values.get(name)) for name, convert in converters.items()])

    def _add_kind(self, type_name: str) -> tuple[Any, dict[str, Callable[[Any], Any]]]:
        """Keep the class of a type with what converts each field, in order: outlines have 100,000s of points."""
        fields: Sequence[tuple[str, tuple[int, Any]]] = self._store.fielddefs[type_name][1]
        converters = {
            name: _SCALARS.get(detail[0], _to_int) if node == Nodetype.BASE else partial(self._convert, (node, detail))
            for name, (node, detail) in fields
        }
        found = self._kinds[type_name] = (self._store.types[type_name], converters)
        return found

    def _convert(self, kind: tuple[int, Any], value: Any) -> Any:
        node, detail = kind
        if node == Nodetype.BASE:
            return _SCALARS.get(detail[0], _to_int)(value)
        if node == Nodetype.NAME:
            return self.make(detail) if value is None else value
        (element, element_detail), count = detail
        if element == Nodetype.BASE and element_detail[0] != "string":
            length = count if node == Nodetype.ARRAY else 0
            dtype = np.dtype(element_detail[0])
            return np.zeros(length, dtype) if value is None else np.ascontiguousarray(value, dtype).reshape(-1)
        if value is None:
            if node == Nodetype.ARRAY:
                return [self._convert((element, element_detail), None) for _ in range(count)]
            return []
        return list(value)


def _to_text(value: Any) -> str:
    return "" if value is None else str(value)


def _to_single(value: Any) -> float:
    # Serialisation drops the other digits; a message that is not serialised must not keep them.
    return 0.0 if value is None else float(np.float32(value))


def _to_float(value: Any) -> float:
    return 0.0 if value is None else float(value)


def _to_int(value: Any) -> int:
    return 0 if value is None else int(value)


_SCALARS: dict[str, Callable[[Any], Any]] = {
    "string": _to_text,
    "bool": bool,
    "float32": _to_single,
    "float64": _to_float,
}
"""What converts a value, or None, for a field; all others are whole numbers."""
