# SPDX-License-Identifier: Apache-2.0
"""The launch files, run against stand-ins for `launch` and `launch_ros`, which no package index has."""

import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from ruamel.yaml import YAML

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.components.registry import COMPONENTS, node_settings

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = {"camera": "image:=/i", "lidar": "points:=/p", "cameras": "cameras:=a,b", "replay": "bag:=b"}


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


class ExecuteProcess(Recorded):
    """One program."""


@pytest.fixture(autouse=True)
def stand_ins(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Put the stand-ins where the launch files import from; the package's share is this tree."""
    actions = {
        "DeclareLaunchArgument": DeclareLaunchArgument,
        "OpaqueFunction": OpaqueFunction,
        "ExecuteProcess": ExecuteProcess,
    }
    content: dict[str, dict[str, Any]] = {
        "launch": {"LaunchDescription": LaunchDescription, "LaunchContext": dict},
        "launch.actions": actions,
        "launch.substitutions": {"LaunchConfiguration": LaunchConfiguration},
        "launch_ros": {},
        "launch_ros.actions": {"Node": Node},
        "ament_index_python": {},
        "ament_index_python.packages": {"get_package_share_directory": {"flowing_puppet_ros": str(ROOT)}.__getitem__},
    }
    for name, members in content.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    shared = "flowing_puppet_ros.node.launching.actions"
    monkeypatch.delitem(sys.modules, shared, raising=False)
    yield
    sys.modules.pop(shared, None)


def described(name: str, **chosen: str) -> list[Recorded]:
    """Return the nodes of a launch file with these arguments."""
    path = ROOT / "launch" / f"{name}.launch.py"
    entities = runpy.run_path(str(path))["generate_launch_description"]().positional[0]
    arguments = {item.positional[0]: item.named for item in entities if isinstance(item, DeclareLaunchArgument)}
    assert set(chosen) <= set(arguments)
    assert all(argument["description"] for argument in arguments.values())
    context = {name: argument.get("default_value", "") for name, argument in arguments.items()} | chosen
    nodes: list[Recorded] = [item for item in entities if isinstance(item, ExecuteProcess)]
    for item in entities:
        if isinstance(item, OpaqueFunction):
            nodes += item.named["function"](context)
    return nodes


def parameters_of(node: Recorded) -> dict[str, Any]:
    """Return the parameters that a node gets: those of its files, later ones before earlier ones, and its own."""
    found: dict[str, Any] = {}
    for source in node.named["parameters"]:
        found |= YAML(typ="safe").load(Path(source))["/**"]["ros__parameters"] if isinstance(source, str) else source
    return found


@pytest.mark.parametrize(("name", "argument"), PROGRAMS.items())
def test_every_file_starts_programs_of_the_package(name: str, argument: str) -> None:
    assert {path.name.removesuffix(".launch.py") for path in (ROOT / "launch").glob("*.py")} >= set(PROGRAMS)
    key, _, value = argument.partition(":=")
    nodes = described(name, **{key: value})
    assert nodes
    for node in nodes:
        if isinstance(node, Node):
            assert node.named["package"] == "flowing_puppet_ros" and node.named["executable"] in COMPONENTS
            kinds = (COMPONENTS[node.named["executable"]].settings_type, node_settings(node.named["executable"]))
            known = {info.name.partition(".")[0] for kind in kinds for info in kind.describe()}
            assert {key.partition(".")[0] for key in parameters_of(node)} <= known | {"use_sim_time"}
            ports = {port.name for port in getattr(COMPONENTS[node.named["executable"]], "inputs", ())}
            assert {own for own, _ in node.named["remappings"]} <= ports or node.named["executable"] == "visual_hull"


def test_a_camera_is_tracked_with_or_without_a_flow_node() -> None:
    (tracker,) = described("camera", image="/c/image", namespace="robot", log_level="debug", humans="true")
    assert (tracker.named["executable"], tracker.named["namespace"]) == ("puppet_tracker", "robot")
    assert tracker.named["remappings"] == [("image", "/c/image")]
    assert tracker.named["arguments"] == ["--ros-args", "--log-level", "debug"]
    assert parameters_of(tracker)["ros4hri.publish"] is True
    flow, tracker = described("camera", image="/c/image", flow="true", detections="/people")
    assert flow.named["executable"] == "optical_flow"
    assert dict(tracker.named["remappings"])["detections"] == "/people"
    assert "ros4hri.publish" not in parameters_of(tracker)


def test_bodies_from_a_cloud_or_from_depth(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text("/**:\n  ros__parameters:\n    view: full\n    model: female\n")
    (fitter,) = described("lidar", points="/lidar", view="single", params_file=str(own))
    assert fitter.named["remappings"] == [("points", "/lidar")]
    found = parameters_of(fitter)
    assert (found["model"], found["view"], found["use_sim_time"]) == ("female", "single", False)
    (fitter,) = described("lidar", depth="/camera/depth", use_sim_time="true")
    assert fitter.named["remappings"] == [("depth", "/camera/depth")]
    assert parameters_of(fitter)["use_sim_time"] is True


def test_colour_and_depth_of_a_camera_are_joined(monkeypatch: pytest.MonkeyPatch) -> None:
    image, info = ["sensor_msgs/msg/Image"], ["sensor_msgs/msg/CameraInfo"]
    seen = {
        "/cam/rgb/image_rect_color": image, "/cam/rgb/camera_info": info,
        "/cam/depth_registered/image": image, "/other/image_raw": image,
    }  # fmt: skip
    monkeypatch.setattr("flowing_puppet_ros.node.launching.rgbd_topics.list_topics", lambda kind: seen)
    tracker, fitter = described("rgbd", camera="/cam", namespace="robot")
    assert (tracker.named["executable"], tracker.named["namespace"]) == ("puppet_tracker", "robot")
    assert tracker.named["remappings"] == [("image", "/cam/rgb/image_rect_color")]
    assert dict(fitter.named["remappings"]) == {
        "depth": "/cam/depth_registered/image",
        "camera_info": "/cam/rgb/camera_info",
        "puppets/camera_info": "/cam/rgb/camera_info",
    }
    assert parameters_of(fitter)["fusion.rectified"] is True


def test_several_cameras_with_depth_give_one_body_a_person(monkeypatch: pytest.MonkeyPatch) -> None:
    image, info = ["sensor_msgs/msg/Image"], ["sensor_msgs/msg/CameraInfo"]
    seen: dict[str, list[str]] = {}
    for camera in ("left", "right"):
        seen |= {f"/{camera}/color/image_raw": image, f"/{camera}/color/camera_info": info}
        seen |= {f"/{camera}/depth/image_rect_raw": image, f"/{camera}/depth/camera_info": info}
    monkeypatch.setattr("flowing_puppet_ros.node.launching.rgbd_topics.list_topics", lambda kind: seen)
    (fitter,) = described("rgbd", camera="/left,right")
    assert parameters_of(fitter)["rig.cameras"] == "left,right"
    assert dict(fitter.named["remappings"]) == {
        "left/depth": "/left/depth/image_rect_raw",
        "left/camera_info": "/left/depth/camera_info",
        "right/depth": "/right/depth/image_rect_raw",
        "right/camera_info": "/right/depth/camera_info",
    }


def test_cameras_with_depth_beside_others_give_one_body_from_silhouettes_and_depth(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    image, info = ["sensor_msgs/msg/Image"], ["sensor_msgs/msg/CameraInfo"]
    seen = {"/left/color/image_raw": image, "/left/color/camera_info": info}
    seen |= {"/left/depth/image_rect_raw": image, "/left/depth/camera_info": info}
    monkeypatch.setattr("flowing_puppet_ros.node.launching.rgbd_topics.list_topics", lambda kind: seen)
    *trackers, hull, fitter = described("cameras", cameras="left/color,door", image="image_raw", depth="/left")
    assert [node.named["namespace"] for node in trackers] == ["left/color", "door"]
    assert parameters_of(hull)["cameras"] == "left/color,door"
    assert parameters_of(fitter)["rig.cameras"] == "left"
    assert dict(fitter.named["remappings"]) == {
        "left/depth": "/left/depth/image_rect_raw",
        "left/camera_info": "/left/depth/camera_info",
    }


def test_bodies_from_cameras() -> None:
    nodes = described("cameras", cameras="a,b", image="image_raw", namespace="rig")
    started = [(node.named["executable"], node.named["namespace"]) for node in nodes]
    assert started == [
        ("puppet_tracker", "rig/a"),
        ("puppet_tracker", "rig/b"),
        ("visual_hull", "rig"),
        ("body_fitter", "rig"),
    ]
    assert parameters_of(nodes[2])["cameras"] == "a,b"
    assert nodes[2].named["remappings"] == [("a/image", "a/image_raw"), ("b/image", "b/image_raw")]
    assert nodes[3].named["remappings"] == []


def test_cameras_that_are_not_named_are_told_with_what_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = {"/a/image_raw": ["sensor_msgs/msg/Image"], "/b/image_raw/compressed": ["sensor_msgs/msg/CompressedImage"]}
    monkeypatch.setattr("flowing_puppet_ros.node.launching.topics.list_topics", lambda kind: seen)
    with pytest.raises(InputError, match=r"cameras:=a,b .* images now: /a/image_raw, /b/image_raw$"):
        described("cameras", cameras="a")


def test_a_recording_is_replayed_by_the_command_line() -> None:
    (program,) = described("replay", bag="in")
    words = [
        word.perform({"bag": "in", "out": "o", "report": "r"}) if isinstance(word, LaunchConfiguration) else word
        for word in program.named["cmd"]
    ]
    from flowing_puppet_ros.cli import make_verb_parser

    _, parser, arguments = make_verb_parser(words[3], words[4:])
    parsed = parser.parse_args(arguments)
    assert words[1:3] == ["-m", "flowing_puppet_ros"] and str(parsed.out) == "o" and str(parsed.report) == "r"
