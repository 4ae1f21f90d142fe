# SPDX-License-Identifier: Apache-2.0
"""A recording of which nothing could be used ends with status 1 and the reason of each topic."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.cli import main
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header
from flowing_puppet_ros.stream.messages.images import make_image
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, POINT_CLOUD

FACTORY = BagMessageFactory()
HEADER = make_header(FACTORY, 5, "eye")
THERMAL = make_image(FACTORY, HEADER, np.zeros((8, 8), np.uint8), "thermal")
PICTURE = make_image(FACTORY, HEADER, np.zeros((32, 32, 3), np.uint8), "rgb8")
DEPTH = make_image(FACTORY, HEADER, np.zeros((8, 8), np.uint16), "16UC1")
BROKEN = FACTORY.make(COMPRESSED_IMAGE, header=HEADER, format="jpeg", data=np.zeros(9, np.uint8))
EMPTY = make_cloud(FACTORY, HEADER, np.zeros((0, 3)))
INFO = FACTORY.make(CAMERA_INFO, header=HEADER, width=8, height=8)


def recorded(path: Path, messages: dict[str, tuple[str, Any]]) -> Path:
    """Write one message per topic; None for a topic without messages, bytes as they are."""
    with BagWriter(path) as writer:
        for topic, (kind, _) in messages.items():
            writer.add_topic(topic, kind)
        for k, (topic, (_, message)) in enumerate(messages.items()):
            if isinstance(message, bytes):
                writer.write_raw(topic, k, message)
            elif message is not None:
                writer.write(topic, k, message)
    return path


@pytest.mark.parametrize(
    ("messages", "reasons"),
    [
        (
            {"/a/image": (IMAGE, THERMAL), "/a/camera_info": (CAMERA_INFO, INFO), "/rgb": (IMAGE, PICTURE)},
            {
                "/a/image": "the image encoding 'thermal' is not one of rgb8",
                "/a/camera_info": "alone gives no result",
                "/rgb": "images are wanted on image, image_raw, image_color, image_rect, image_rect_color; --topic-map "
                "/rgb:=/image",
            },
        ),
        ({"/a/image/compressed": (COMPRESSED_IMAGE, BROKEN)}, {"/a/image/compressed": "of format 'jpeg' and 9 bytes"}),
        ({"/a/image": (IMAGE, b"\0\1\0\0\7")}, {"/a/image": "is not the sensor_msgs/msg/Image that it claims to be"}),
        (
            {
                "/lidar/points": (POINT_CLOUD, EMPTY),
                "/imu": ("sensor_msgs/msg/Imu", FACTORY.make("sensor_msgs/msg/Imu")),
            },
            {"/lidar/points": "the cloud has no finite point", "/imu": "the type sensor_msgs/msg/Imu is not read"},
        ),
        (
            {"/a/image": (IMAGE, None), "/depth/image": (IMAGE, DEPTH)},
            {"/a/image": "no messages", "/depth/image": "there is no /depth/camera_info"},
        ),
        (
            {"/cam/depth/image": (IMAGE, DEPTH), "/cam/depth/camera_info": (CAMERA_INFO, INFO)},
            {"/cam/depth/image": "the camera_info is uncalibrated"},
        ),
    ],
)
def test_the_reason_of_each_topic_is_told(
    messages: dict[str, Any], reasons: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag, out = recorded(tmp_path / "in.mcap", messages), tmp_path / "out.mcap"
    assert main(["replay", str(bag), "--out", str(out), "--json"]) == 1
    said = capsys.readouterr()
    summary = json.loads(said.out)
    assert set(summary["unused"]) == set(messages)
    for topic, reason in reasons.items():
        assert reason in summary["unused"][topic], topic
    last = said.err.splitlines()[-1]
    assert last.startswith(f"flowing-puppet replay: nothing in {bag} could be used: ")
    assert all(f"{topic}: " in last for topic in messages)


def test_a_recording_of_which_something_was_used_ends_well(tmp_path: Path) -> None:
    bag = recorded(tmp_path / "in.mcap", {"/a/image": (IMAGE, PICTURE), "/b/image": (IMAGE, THERMAL)})
    assert main(["replay", str(bag), "--out", str(tmp_path / "out.mcap")]) == 0


def test_one_of_several_that_could_not_be_used_has_failed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = recorded(tmp_path / "good.mcap", {"/a/image": (IMAGE, PICTURE)})
    bad = recorded(tmp_path / "bad.mcap", {"/a/image": (IMAGE, THERMAL)})
    assert main(["replay", str(good), str(bad), "--out", str(tmp_path / "out"), "--jobs", "1"]) == 1
    assert f"1 of 2 inputs failed: {bad}" in capsys.readouterr().err
