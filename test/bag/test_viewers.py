# SPDX-License-Identifier: Apache-2.0
"""The RViz and Foxglove files show what a replay's bag really has: topics, types, fields and frames."""

import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.typestore import typestore
from flowing_puppet_ros.stream.messages.geometry import FrameTree

CONFIG = Path(__file__).resolve().parents[2] / "config"
SHOWN_BY = {
    "rviz_default_plugins/MarkerArray": {"visualization_msgs/msg/MarkerArray"},
    "rviz_default_plugins/PointCloud2": {"sensor_msgs/msg/PointCloud2"},
    "rviz_default_plugins/PoseArray": {"geometry_msgs/msg/PoseArray"},
    "rviz_default_plugins/Image": {"sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"},
    "3D": {"visualization_msgs/msg/MarkerArray", "sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/PoseArray"},
    "Image": {"sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"},
}


@pytest.fixture(scope="module")
def topics(golden: Any) -> dict[str, str]:
    """Topics and types of the demo's output: those of the golden replay under the names of the demo's cameras."""
    with open_bag(golden.replay) as bag:
        held = {name: detail.type for name, detail in bag.details.items() if detail.count}
    cameras = [f"cam{number:02d}" for number in range(1, 5)]
    assert set(cameras) == set(tomllib.loads((CONFIG.parent / "bags" / "calibration.toml").read_text()))
    renamed = {}
    for name, kind in held.items():
        renamed[re.sub(r"^/cam(\d)/", r"/cam0\1/", name)] = kind
    return renamed


@pytest.fixture(scope="module")
def layout() -> dict[str, Any]:
    return dict(json.loads((CONFIG / "demo.foxglove.json").read_text()))


def rviz() -> dict[str, Any]:
    return dict(YAML(typ="safe").load((CONFIG / "demo.rviz").read_text())["Visualization Manager"])


def test_rviz_shows_topics_of_its_displays_types(topics: dict[str, str]) -> None:
    displays = [display for display in rviz()["Displays"] if "Topic" in display]
    assert len(displays) == 8
    for display in displays:
        topic = display["Topic"]
        assert topics[topic["Value"]] in SHOWN_BY[display["Class"]], topic["Value"]
        assert topic["Reliability Policy"] == "Reliable"


def test_the_fixed_frame_holds_everything(golden: Any, layout: dict[str, Any]) -> None:
    frames = FrameTree()
    with open_bag(golden.replay) as bag:
        for record in bag.messages(["/tf_static"]):
            frames.add(record.message)
        shown = {record.message.header.frame_id for record in bag.messages(["/bodies", "/hull", "/part_poses"])}
    assert {frames.find_root(frame) for frame in shown} == {rviz()["Global Options"]["Fixed Frame"]} == {"world"}
    assert layout["configById"]["3D!bodies"]["followTf"] == "world"


def test_foxglove_shows_topics_of_its_panels_types(topics: dict[str, str], layout: dict[str, Any]) -> None:
    panels = layout["configById"]
    assert sorted(leaves(layout["layout"])) == sorted(panels)
    for topic in panels["3D!bodies"]["topics"]:
        assert topics[topic] in SHOWN_BY["3D"], topic
    images = [panel["imageMode"]["imageTopic"] for name, panel in panels.items() if name.startswith("Image!")]
    assert len(images) == 4 and all(topics[topic] in SHOWN_BY["Image"] for topic in images)
    assert panels["RawMessages!bodies"]["topicPath"] in topics


def test_foxglove_plots_fields_that_messages_have(topics: dict[str, str], layout: dict[str, Any]) -> None:
    plots = [panel for name, panel in layout["configById"].items() if name.startswith("Plot!")]
    paths = [path["value"] for plot in plots for path in plot["paths"]]
    assert len(paths) == 10
    for path in paths:
        topic, *steps = path.split(".")
        kind = topics[topic]
        for step in steps:
            kind = field_type(kind, step.partition("[")[0])
        assert kind == "float32", path


def field_type(kind: str, name: str) -> str:
    """The type of a field of a message, of its elements if it is a list."""
    described: Any = dict(typestore().fielddefs[kind][1])[name]
    while described[0] in (3, 4):
        described = described[1][0]
    return str(described[1][0] if described[0] == 1 else described[1])


def leaves(split: Any) -> Iterator[str]:
    """The panels of a layout."""
    if isinstance(split, str):
        yield split
    else:
        yield from leaves(split["first"])
        yield from leaves(split["second"])
