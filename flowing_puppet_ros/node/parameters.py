# SPDX-License-Identifier: Apache-2.0
"""ROS parameters out of a settings dataclass."""

from __future__ import annotations

from typing import TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.settings import SettingInfo, Settings

S = TypeVar("S", bound=Settings)
_INT64 = 2**63 - 1
_FLOAT = 1.7976931348623157e308


def descriptor(info: SettingInfo) -> ParameterDescriptor:
    """Return what tools show of a setting: its help, range and choices; it is fixed when the node starts."""
    made = ParameterDescriptor(name=info.name, description=info.description, read_only=True)
    if info.choices:
        made.additional_constraints = "one of " + ", ".join(info.choices)
    if info.low is None and info.high is None:
        return made
    if info.type is int:
        low, high = -_INT64 if info.low is None else int(info.low), _INT64 if info.high is None else int(info.high)
        made.integer_range = [IntegerRange(from_value=low, to_value=high, step=0)]
    elif info.type is float:
        bounds = (-_FLOAT if info.low is None else float(info.low), _FLOAT if info.high is None else float(info.high))
        made.floating_point_range = [FloatingPointRange(from_value=bounds[0], to_value=bounds[1], step=0.0)]
    return made


def declare[S: Settings](node: Node, settings_type: type[S]) -> S:
    """Declare one parameter a setting and return the settings with the values that the node was started with.

    Raises InputError in one sentence when a value has the wrong type or is out of range.
    """
    values = {}
    for info in settings_type.describe():
        try:
            values[info.name] = node.declare_parameter(info.name, info.default, descriptor(info)).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            reason = str(error).removesuffix(f": {info.name}")
            raise InputError(f"parameter {info.name}: {reason}; it is the {info.description}") from error
    return settings_type.from_mapping(values)
