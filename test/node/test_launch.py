# SPDX-License-Identifier: Apache-2.0
"""The launch files, run against stand-ins for `launch` and `launch_ros`, which no package index has."""

import runpy
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from flowing_puppet_ros.stream.components.registry import COMPONENTS

LAUNCH = Path(__file__).resolve().parents[2] / "launch"


class Recorded:
    """Any launch entity: keeps what it was made with."""

    def __init__(self, *positional: Any, **named: Any) -> None:
        self.positional, self.named = positional, named


class LaunchDescription(Recorded):
    """The entities of a description."""


class DeclareLaunchArgument(Recorded):
    """One argument."""


class OpaqueFunction(Recorded):
    """A function of the context."""


class LaunchConfiguration(Recorded):
    """The value of an argument, here what the context (a dict) has."""

    def perform(self, context: dict[str, str]) -> str:
        return context[self.positional[0]]


class Node(Recorded):
    """One node."""


@pytest.fixture
def stand_ins(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Put the stand-ins where the launch files import from."""
    content: dict[str, dict[str, Any]] = {
        "launch": {"LaunchDescription": LaunchDescription, "LaunchContext": dict},
        "launch.actions": {"DeclareLaunchArgument": DeclareLaunchArgument, "OpaqueFunction": OpaqueFunction},
        "launch.conditions": {"IfCondition": Recorded},
        "launch.substitutions": {"LaunchConfiguration": LaunchConfiguration},
        "launch_ros": {},
        "launch_ros.actions": {"Node": Node},
    }
    for name, members in content.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    yield


def described(name: str, **chosen: str) -> list[Node]:
    """Return the nodes of a launch file with these arguments."""
    entities = runpy.run_path(str(LAUNCH / name))["generate_launch_description"]().positional[0]
    arguments = {item.positional[0]: item.named for item in entities if isinstance(item, DeclareLaunchArgument)}
    assert set(chosen) <= set(arguments)
    assert all(argument["description"] for argument in arguments.values())
    context = {name: argument["default_value"] for name, argument in arguments.items()} | chosen
    nodes = [item for item in entities if isinstance(item, Node)]
    for item in entities:
        if isinstance(item, OpaqueFunction):
            nodes += item.named["function"](context)
    for key in ("config", "flow_config", "tracker_config"):
        assert key not in context or Path(context[key]).exists()
    return nodes


@pytest.mark.usefixtures("stand_ins")
def test_tracking_starts_flow_and_tracker() -> None:
    nodes = described("puppet_tracker.launch.py")
    assert [node.named["executable"] for node in nodes] == ["optical_flow", "puppet_tracker"]
    assert "condition" in nodes[0].named


@pytest.mark.usefixtures("stand_ins")
def test_bodies_from_points() -> None:
    (fitter,) = described("bodies.launch.py", points="/lidar", depth="/camera/depth")
    assert fitter.named["executable"] == "body_fitter"
    remapped = dict(fitter.named["remappings"])
    assert (remapped["points"], remapped["depth"], remapped["camera_info"]) == (
        "/lidar",
        "/camera/depth",
        "camera_info",
    )


@pytest.mark.usefixtures("stand_ins")
def test_bodies_from_cameras() -> None:
    nodes = described("bodies.launch.py", cameras="a,b", image="image_raw")
    started = [(node.named["executable"], node.named["namespace"]) for node in nodes]
    assert started == [("puppet_tracker", "a"), ("puppet_tracker", "b"), ("visual_hull", ""), ("body_fitter", "")]
    assert {name for name, _ in started} <= set(COMPONENTS)
    assert nodes[2].named["parameters"][-1] == {"cameras": "a,b"}
    assert dict(nodes[2].named["remappings"])["b/image"] == "b/image_raw"
    assert nodes[3].named["remappings"] == []


@pytest.mark.parametrize("name", ["puppet_tracker.launch.py", "bodies.launch.py"])
def test_without_launch_one_sentence(name: str) -> None:
    done = subprocess.run([sys.executable, "-P", LAUNCH / name], capture_output=True, text=True, cwd="/")
    if done.returncode == 0:
        pytest.skip("launch is installed here")
    assert len(done.stderr.strip().splitlines()) == 1
    assert "sourced ROS 2 Jazzy" in done.stderr
