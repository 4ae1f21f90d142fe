# SPDX-License-Identifier: Apache-2.0
"""ROS parameters from a settings dataclass: declared once, checked before a change and read after it."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.settings import SettingInfo, Settings

_MAX_INT64 = 2**63 - 1
_MAX_FLOAT64 = 1.7976931348623157e308


def make_descriptor(info: SettingInfo, fixed: bool = False) -> ParameterDescriptor:
    """Return the descriptor of a setting: its help, range and choices; a `fixed` one is read-only once started."""
    made = ParameterDescriptor(name=info.name, description=info.description, read_only=fixed)
    if info.choices:
        made.additional_constraints = "one of " + ", ".join(info.choices)
    if info.low is None and info.high is None:
        return made
    if info.type is int:
        low, high = (
            -_MAX_INT64 if info.low is None else int(info.low),
            _MAX_INT64 if info.high is None else int(info.high),
        )
        made.integer_range = [IntegerRange(from_value=low, to_value=high, step=0)]
    elif info.type is float:
        bounds = (
            -_MAX_FLOAT64 if info.low is None else float(info.low),
            _MAX_FLOAT64 if info.high is None else float(info.high),
        )
        made.floating_point_range = [FloatingPointRange(from_value=bounds[0], to_value=bounds[1], step=0.0)]
    return made


def declare[S: Settings](node: Node, settings_type: type[S], fixed: Collection[str] = ()) -> S:
    """Declare one parameter per setting and return the settings with the values that the node was started with.

    Advanced ones are declared only when they are given. Those in `fixed` cannot be changed later. InputError in one
    sentence when a value has the wrong type or is out of range.
    """
    values = {}
    for info in settings_type.describe():
        if info.advanced and info.name not in node._parameter_overrides:
            continue
        made = make_descriptor(info, info.name in fixed)
        try:
            values[info.name] = node.declare_parameter(info.name, info.default, made).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            reason = str(error).removesuffix(f": {info.name}")
            raise InputError(f"parameter {info.name}: {reason}; it is the {info.description}") from error
    return settings_type.from_mapping(values)


def apply_changes[S: Settings](settings: S, parameters: Iterable[Parameter]) -> S:
    """Return `settings` with the values of the parameters that belong to them; InputError if a value is unusable."""
    known = settings.values()
    return settings.with_values(
        {parameter.name: parameter.value for parameter in parameters if parameter.name in known}
    )


def convert_to_floats(settings_types: Iterable[type[Settings]], parameters: Iterable[Parameter]) -> list[Parameter]:
    """Return the parameters with whole numbers for floating-point settings (`gate 3`) converted to floats."""
    floats = {info.name for kind in settings_types for info in kind.describe() if info.type is float}

    def convert(parameter: Parameter) -> Parameter:
        whole = parameter.name in floats and parameter.type_ == Parameter.Type.INTEGER
        return Parameter(parameter.name, value=float(parameter.value)) if whole else parameter

    return [convert(parameter) for parameter in parameters]
