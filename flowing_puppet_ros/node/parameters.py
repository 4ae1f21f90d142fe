# SPDX-License-Identifier: Apache-2.0
"""ROS parameters out of a settings dataclass: declared once, checked before a change and read after it."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.settings import SettingInfo, Settings

S = TypeVar("S", bound=Settings)
_INT64 = 2**63 - 1
_FLOAT = 1.7976931348623157e308


def descriptor(info: SettingInfo, fixed: bool = False) -> ParameterDescriptor:
    """Return what tools show of a setting: its help, range and choices, and whether it is `fixed` once started."""
    made = ParameterDescriptor(name=info.name, description=info.description, read_only=fixed)
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


def declare[S: Settings](node: Node, settings_type: type[S], fixed: Collection[str] = ()) -> S:
    """Declare one parameter a setting and return the settings with the values that the node was started with.

    Those in `fixed` cannot be changed later. Raises InputError in one sentence when a value has the wrong type or is
    out of range.
    """
    values = {}
    for info in settings_type.describe():
        made = descriptor(info, info.name in fixed)
        try:
            values[info.name] = node.declare_parameter(info.name, info.default, made).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            reason = str(error).removesuffix(f": {info.name}")
            raise InputError(f"parameter {info.name}: {reason}; it is the {info.description}") from error
    return settings_type.from_mapping(values)


def changed[S: Settings](settings: S, parameters: Iterable[Parameter]) -> S:
    """Return `settings` with the values of those parameters that are among them; InputError when one is unusable."""
    values = {info.name: getattr(settings, info.name) for info in type(settings).describe()}
    values |= {parameter.name: parameter.value for parameter in parameters if parameter.name in values}
    return type(settings)(**values)


def with_floats(settings_types: Iterable[type[Settings]], parameters: Iterable[Parameter]) -> list[Parameter]:
    """Return the parameters, whole numbers for a floating-point setting (`gate 3`) as such numbers."""
    floats = {info.name for kind in settings_types for info in kind.describe() if info.type is float}

    def converted(parameter: Parameter) -> Parameter:
        whole = parameter.name in floats and parameter.type_ == Parameter.Type.INTEGER
        return Parameter(parameter.name, value=float(parameter.value)) if whole else parameter

    return [converted(parameter) for parameter in parameters]
