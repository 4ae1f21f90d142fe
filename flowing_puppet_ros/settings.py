# SPDX-License-Identifier: Apache-2.0
"""One source for settings: frozen dataclasses from which ROS parameters, YAML and command-line flags are made.

@dataclass(frozen=True, slots=True)
class FilterSettings(Settings):
    kind: str = setting("median", "kind of filter", choices=("mean", "median"))
    window: int = setting(5, "width of the window", unit="px", low=1, high=99)

@dataclass(frozen=True)
class ExampleNodeSettings(Settings):
    filter: FilterSettings = nested(FilterSettings, window=7)  # `filter.kind`, `filter.window`
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import reduce
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
    advanced: bool = False,
) -> Any:
    """Declare a dataclass field with the help text, unit, inclusive range or choices that every front end shows.

    An `advanced` one is not offered: front ends take it when it is given by name, and reference pages list it apart.
    """
    shown = {"help": help, "unit": unit, "low": low, "high": high, "choices": choices, "advanced": advanced}
    return field(default=default, metadata=shown)


def nested(kind: type[Settings], **changed: Any) -> Any:
    """Declare a dataclass field for the settings of a part, with `changed` defaults; their names are `field.name`."""
    return field(default=kind(**changed))


_METAVARS = {int: "N", float: "X"}
"""What stands for the value of a flag in its help."""


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
    advanced: bool

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

    def check(self, value: Any) -> Any:
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
            if "." not in info.name:
                object.__setattr__(self, info.name, info.check(getattr(self, info.name)))

    @classmethod
    def describe(cls) -> Iterator[SettingInfo]:
        """Yield the settings in the order of their declaration; those of a part have names like `flow.preset`."""
        types = get_type_hints(cls)
        for item in dataclasses.fields(cls):  # type: ignore[arg-type]
            kind = types[item.name]
            if not issubclass(kind, Settings):
                yield SettingInfo(item.name, kind, item.default, **item.metadata)
                continue
            for info in kind.describe():
                name, default = f"{item.name}.{info.name}", item.default.value(info.name)
                yield dataclasses.replace(info, name=name, default=default)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Self:
        """Make an instance from a parameter file or another mapping; unknown names are refused by name.

        The settings of a part are a mapping of their own, or have dotted names.
        """
        return cls().with_values(values)

    def value(self, name: str) -> Any:
        """Return the value of the setting of this name."""
        return reduce(getattr, name.split("."), self)

    def values(self) -> dict[str, Any]:
        """Return all settings by name."""
        return {info.name: self.value(info.name) for info in self.describe()}

    def with_values(self, values: Mapping[str, Any]) -> Self:
        """Return these settings with some of them changed; InputError for a name or a value that cannot be."""
        known = {info.name: info for info in self.describe()}
        flat = dict(_flatten(values, {name.rpartition(".")[0] for name in known}))
        unknown = sorted(set(flat) - set(known))
        if unknown:
            raise InputError(f"unknown setting {unknown[0]!r}; known are {', '.join(sorted(known))}")
        return self._replace({name: known[name].check(value) for name, value in flat.items()})

    def _replace(self, flat: Mapping[str, Any]) -> Self:
        own: dict[str, Any] = {}
        inner: dict[str, dict[str, Any]] = {}
        for name, value in flat.items():
            head, dot, rest = name.partition(".")
            if dot:
                inner.setdefault(head, {})[rest] = value
            else:
                own[head] = value
        own |= {head: getattr(self, head)._replace(values) for head, values in inner.items()}
        return dataclasses.replace(self, **own)  # type: ignore[type-var]

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser, skip: tuple[str, ...] = (), main: str = "") -> None:
        """Add a flag for each setting to `parser`; advanced ones are not listed in the help.

        That of `flow.max_side` is `--flow-max-side`; those of the part called `main` are named without it.
        """
        for info in cls.describe():
            if info.name in skip:
                continue
            flag = "--" + info.name.removeprefix(f"{main}.").replace("_", "-").replace(".", "-")
            text = f"{info.description} [{info.default}]".replace("%", "%%")
            shown: dict[str, Any] = {"dest": info.name, "default": info.default}
            shown["help"] = argparse.SUPPRESS if info.advanced else text
            if info.type is bool:
                parser.add_argument(flag, action=argparse.BooleanOptionalAction, **shown)
            else:
                metavar = "|".join(map(str, info.choices)) or _METAVARS.get(info.type, "TEXT")
                parser.add_argument(flag, type=info.type, metavar=metavar, **shown)

    @classmethod
    def from_arguments(cls, arguments: argparse.Namespace) -> Self:
        """Make an instance from the flags that `add_arguments` added; flags that were skipped keep their defaults."""
        given = vars(arguments)
        names = [info.name for info in cls.describe()]
        return cls.from_mapping({name: given[name] for name in names if name in given})


def _flatten(values: Mapping[str, Any], parts: set[str], before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted names and values of a mapping that may hold mappings of `parts`."""
    for key, value in values.items():
        name = f"{before}{key}"
        if name in parts and isinstance(value, Mapping):
            yield from _flatten(value, parts, f"{name}.")
        else:
            yield name, value


def make_out_folder(path: Path) -> None:
    """Make the folder that an `--out` flag names, with its parents; InputError when it cannot be made."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {path} cannot be made: {error.strerror}; choose another folder") from error
