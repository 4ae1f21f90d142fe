# SPDX-License-Identifier: Apache-2.0
"""The nodes by name, and the parameter files that are generated from their settings.

Nothing here needs ROS, so that the files can be written and checked without it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from flowing_puppet_ros.settings import Settings, setting
from flowing_puppet_ros.stream.component import Component
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent
from flowing_puppet_ros.stream.components.optical_flow import OpticalFlowComponent
from flowing_puppet_ros.stream.components.puppet_tracker import PuppetTrackerComponent
from flowing_puppet_ros.stream.components.visual_hull import VisualHullComponent

COMPONENTS: dict[str, type[Component]] = {
    "optical_flow": OpticalFlowComponent,
    "puppet_tracker": PuppetTrackerComponent,
    "visual_hull": VisualHullComponent,
    "body_fitter": BodyFitterComponent,
}
"""The component that each node runs."""


QUEUE = "messages of one input that may wait; the oldest is dropped for a newer"


@dataclass(frozen=True)
class NodeSettings(Settings):
    """Settings that every node has beside those of its component."""

    queue: int = setting(1, QUEUE, low=1, high=1000)
    autostart: bool = setting(True, "configure and activate at the start; without, a lifecycle manager does")


@dataclass(frozen=True)
class HullNodeSettings(NodeSettings):
    """Where many inputs make one set, those that come late must find the others still there."""

    queue: int = setting(4, QUEUE, low=1, high=1000)


FIXED = frozenset({"autostart"})
"""Settings of every node that cannot be changed once it runs."""


def node_settings(name: str) -> type[NodeSettings]:
    """Return the settings that the node `name` has beside its component's."""
    return HullNodeSettings if name == "visual_hull" else NodeSettings


def parameter_yaml(name: str) -> str:
    """Return the text of config/`name`.yaml: every parameter of the node at its default, with its meaning."""
    lines = [
        "# SPDX-License-Identifier: Apache-2.0",
        f"# Parameters of the node {name} at their defaults; `make config` writes this file from the settings.",
        f"/**/{name}:",
        "  ros__parameters:",
    ]
    for settings_type in (COMPONENTS[name].settings_type, node_settings(name)):
        for info in settings_type.describe():
            lines += [f"    # {info.description}", f"    {info.name}: {_scalar(info.default)}"]
    return "\n".join(lines) + "\n"


def _scalar(value: Any) -> str:
    """Return a value as YAML that keeps its type: numbers with a point or an exponent with one are floating point."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    text = repr(value)
    return text.replace("e", ".0e") if "e" in text and "." not in text else text
