# SPDX-License-Identifier: Apache-2.0
"""One source for settings: frozen dataclasses from which ROS parameters, YAML and command-line flags are made.

@dataclass(frozen=True, slots=True)
class FlowSettings(Settings):
    preset: str = setting("medium", "DIS preset", choices=("ultrafast", "fast", "medium"))
    max_side: int = setting(640, "longest image side the flow is computed at", unit="px", low=32, high=8192)
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self, get_type_hints

from flowing_puppet_ros.errors import InputError


def setting(
    default: Any,
    help: str,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    """Declare a dataclass field with the help text, unit, inclusive range or choices that every front end shows."""
    return field(default=default, metadata={"help": help, "unit": unit, "low": low, "high": high, "choices": choices})


@dataclass(frozen=True, slots=True)
class SettingInfo:
    """What a front end needs to offer one setting."""

    name: str
    type: type
    default: Any
    help: str
    unit: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]

    @property
    def description(self) -> str:
        """The help text with unit, range or choices, for parameter descriptors and `--help`."""
        limits = []
        if self.unit:
            limits.append(self.unit)
        if self.low is not None or self.high is not None:
            limits.append(f"{_bound(self.low)} to {_bound(self.high)}")
        if self.choices:
            limits.append("one of " + ", ".join(self.choices))
        return f"{self.help} ({'; '.join(limits)})" if limits else self.help

    def checked(self, value: Any) -> Any:
        """Return `value` as this setting's type; raise InputError when it has another type or is out of range."""
        if self.type is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if not isinstance(value, self.type) or (self.type is int and isinstance(value, bool)):
            raise InputError(f"{self.name} is {value!r}, which is not a {self.type.__name__}")
        if self.choices and value not in self.choices:
            raise InputError(f"{self.name} is {value!r}, which is not one of {', '.join(self.choices)}")
        if isinstance(value, int | float):
            low = -math.inf if self.low is None else self.low
            high = math.inf if self.high is None else self.high
            if not low <= value <= high:
                raise InputError(f"{self.name} is {value}, outside {_bound(self.low)} to {_bound(self.high)}")
        return value


def _bound(value: float | None) -> str:
    return "any" if value is None else f"{value:g}"


class Settings:
    """Mixin of the frozen, slotted settings dataclasses: checks every value when an instance is made."""

    __slots__ = ()

    def __post_init__(self) -> None:
        """Check types and ranges; raise InputError with the name and value of the first bad setting."""
        for info in self.describe():
            object.__setattr__(self, info.name, info.checked(getattr(self, info.name)))

    @classmethod
    def describe(cls) -> Iterator[SettingInfo]:
        """Yield the settings in the order of their declaration."""
        types = get_type_hints(cls)
        for item in dataclasses.fields(cls):  # type: ignore[arg-type]
            yield SettingInfo(item.name, types[item.name], item.default, **item.metadata)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Self:
        """Make an instance from a parameter file or another mapping; unknown names are refused by name."""
        known = {info.name for info in cls.describe()}
        unknown = sorted(set(values) - known)
        if unknown:
            raise InputError(f"unknown setting {unknown[0]!r}; known are {', '.join(sorted(known))}")
        return cls(**values)

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser, skip: tuple[str, ...] = ()) -> None:
        """Add one `--name` flag a setting to `parser`."""
        for info in cls.describe():
            if info.name in skip:
                continue
            flag = "--" + info.name.replace("_", "-")
            text = f"{info.description} [{info.default}]".replace("%", "%%")
            if info.type is bool:
                action = argparse.BooleanOptionalAction
                parser.add_argument(flag, dest=info.name, action=action, default=info.default, help=text)
            else:
                parser.add_argument(flag, dest=info.name, type=info.type, default=info.default, help=text)

    @classmethod
    def from_arguments(cls, arguments: argparse.Namespace) -> Self:
        """Make an instance from the flags that `add_arguments` added; flags that were skipped keep their defaults."""
        names = {info.name for info in cls.describe()}
        return cls(**{name: value for name, value in vars(arguments).items() if name in names})


def make_out_folder(path: Path) -> None:
    """Make the folder that an `--out` flag names, with its parents; InputError when it cannot be made."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {path} cannot be made: {error.strerror}; choose another folder") from error
