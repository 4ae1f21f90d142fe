# SPDX-License-Identifier: Apache-2.0
"""The nodes by name, and the parameter files that are generated from their settings.

Nothing here needs ROS, so that the files can be written and checked without it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from flowing_puppet_ros.settings import SettingInfo, Settings, setting
from flowing_puppet_ros.stream.component import Component

_CLASSES = {
    "optical_flow": "OpticalFlowComponent",
    "puppet_tracker": "PuppetTrackerComponent",
    "visual_hull": "VisualHullComponent",
    "body_fitter": "BodyFitterComponent",
}
"""Node -> its component, in the module of the node's name."""


class _Components(Mapping[str, type[Component[Any]]]):
    """The components by node; each is imported when it is asked for, since a node needs no other's modules."""

    def __getitem__(self, name: str) -> type[Component[Any]]:
        own = _CLASSES[name]  # a KeyError where there is no such node
        kind: type[Component[Any]] = getattr(import_module(f"{__package__}.{name}"), own)
        return kind

    def __iter__(self) -> Iterator[str]:
        return iter(_CLASSES)

    def __len__(self) -> int:
        return len(_CLASSES)


COMPONENTS = _Components()
"""The component that each node runs."""


QUEUE_HELP = "messages of each input that may wait; a newer one replaces the oldest"


@dataclass(frozen=True)
class NodeSettings(Settings):
    """Settings that every node has beside those of its component."""

    queue: int = setting(1, QUEUE_HELP, low=1, high=1000)
    image_transport: str = setting(
        "auto",
        "images to subscribe to, never both: auto: those that are published, raw ones first",
        choices=("auto", "raw", "compressed"),
    )
    autostart: bool = setting(True, "configure and activate on start-up; off: a lifecycle manager does it")


@dataclass(frozen=True)
class HullNodeSettings(NodeSettings):
    """Where many inputs make one set, those that come late must find the others still there."""

    queue: int = setting(4, QUEUE_HELP, low=1, high=1000)


FIXED_SETTINGS = frozenset({"autostart"})
"""Settings of every node that cannot be changed once it runs."""


def node_settings(name: str) -> type[NodeSettings]:
    """Return the settings that the node `name` has beside its component's."""
    return HullNodeSettings if name == "visual_hull" else NodeSettings


def parameter_yaml(name: str) -> str:
    """Return the text of config/`name`.yaml: every parameter of the node at its default, with its meaning."""
    lines = [
        "# SPDX-License-Identifier: Apache-2.0",
        f"# Parameters of the node {name} at their defaults; `make config` writes this file from the settings.",
        "# Advanced parameters, which the documentation lists, can be set in the same way.",
        "/**:",
        "  ros__parameters:",
    ]
    parts: list[str] = []
    for info in published(name):
        *above, leaf = info.name.split(".")
        for depth, part in enumerate(above):
            if above[: depth + 1] != parts[: depth + 1]:
                lines.append(f"{_indent(depth)}{part}:")
        parts, indent = above, _indent(len(above))
        lines += [f"{indent}# {info.description}", f"{indent}{leaf}: {_to_yaml(info.default)}"]
    return "\n".join(lines) + "\n"


def _indent(depth: int) -> str:
    """Return the spaces before a parameter of a part at some depth."""
    return " " * (4 + 2 * depth)


def published(name: str) -> list[SettingInfo]:
    """Return the settings of a node that are offered: those of the node, of its component, then of its parts."""
    kinds = (COMPONENTS[name].settings_type, node_settings(name))
    infos = [info for kind in kinds for info in kind.describe() if not info.advanced]
    return sorted(infos, key=lambda info: "." in info.name)


def _to_yaml(value: Any) -> str:
    """Return a value as YAML that keeps its type: numbers with a point or an exponent with one are floating point."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    text = repr(value)
    return text.replace("e", ".0e") if "e" in text and "." not in text else text
