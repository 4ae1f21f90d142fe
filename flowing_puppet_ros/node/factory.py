# SPDX-License-Identifier: Apache-2.0
"""Makes rclpy messages; `bag.typestore` makes those of bags."""

from __future__ import annotations

import array
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import Array

# Element type of a sequence field -> type code of the array.array that rclpy keeps it in.
_TYPE_CODES = {
    "float": "f",
    "double": "d",
    "int8": "b",
    "uint8": "B",
    "octet": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
}


@cache
def message_type(type_name: str) -> Any:
    """Return the class of `package/msg/Name`."""
    package, kind, name = type_name.split("/")
    return getattr(import_module(f"{package}.{kind}"), name)


def is_installed(type_name: str) -> bool:
    """Return whether messages of type `package/msg/Name` can be made on this machine."""
    try:
        message_type(type_name)
    except (ImportError, AttributeError):
        return False
    return True


class RosMessageFactory:
    """Makes rclpy messages from plain values and arrays."""

    def make(self, type_name: str, **values: Any) -> Any:
        """Make a message of type `package/msg/Name`; fields without a value keep the message's defaults."""
        kind = message_type(type_name)
        fields = _field_types(kind)
        message = kind()
        for name, value in values.items():
            if name not in fields:
                raise TypeError(f"{type_name} has no field {name!r}")
            setattr(message, name, _convert(fields[name], value))
        return message


@cache
def _field_types(kind: Any) -> dict[str, str]:
    return dict(kind.get_fields_and_field_types())


def _convert(field: str, value: Any) -> Any:
    """Return `value` as the Python type that rclpy expects in a field of type `field`."""
    if field == "float":
        # Serialisation drops these digits; a message that is not serialised must not keep them.
        return float(np.float32(value))
    if field == "double":
        return float(value)
    if field == "boolean":
        return bool(value)
    if field in _TYPE_CODES:
        return int(value)
    if field.startswith("sequence<"):
        element = field.removeprefix("sequence<").split(",")[0].rstrip(">").strip()
        return _to_array(_TYPE_CODES[element], value) if element in _TYPE_CODES else list(value)
    if field.endswith("]") and field.split("[")[0] in _TYPE_CODES:
        code = _TYPE_CODES[field.split("[")[0]]
        return np.ascontiguousarray(value, np.dtype(code)).reshape(-1)
    return value


def _to_array(code: str, value: Any) -> array.array[Any]:
    if isinstance(value, array.array) and value.typecode == code:
        return value
    numbers: Array = np.ascontiguousarray(value, np.dtype(code)).reshape(-1)
    made = array.array(code)
    made.frombytes(memoryview(numbers).cast("B"))
    return made
