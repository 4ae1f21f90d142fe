# SPDX-License-Identifier: Apache-2.0
"""What the doctor says of recordings: what would be computed, what is wrong, and commands that exist."""

import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shown_commands import check  # type: ignore[import-not-found]

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.cli import main
from flowing_puppet_ros.doctor.finding import Inspection
from flowing_puppet_ros.doctor.inspect import inspect_input
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header
from flowing_puppet_ros.stream.messages.images import make_image
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO, IMAGE, POINT_CLOUD, PUPPETS

GOLDEN = Path(__file__).resolve().parents[2] / "bags" / "golden" / "golden.mcap"
FACTORY = BagMessageFactory()
STEP_NS = 50_000_000
"""Between the messages of the recordings made here: 20 Hz."""
K = np.array([500.0, 0, 32, 0, 500, 24, 0, 0, 1])


def picture(stamp: int, frame: str = "eye") -> Any:
    return make_image(FACTORY, make_header(FACTORY, stamp, frame), np.zeros((48, 64, 3), np.uint8), "rgb8")


def depth(stamp: int) -> Any:
    return make_image(FACTORY, make_header(FACTORY, stamp, "eye"), np.full((48, 64), 2000, np.uint16), "16UC1")


def info(stamp: int, k: np.ndarray = K, width: int = 64) -> Any:
    return FACTORY.make(CAMERA_INFO, header=make_header(FACTORY, stamp, "eye"), width=width, height=48, k=k)


def cloud(stamp: int, count: int = 30) -> Any:
    return make_cloud(FACTORY, make_header(FACTORY, stamp, "lidar"), np.ones((count, 3)))


def detections(stamp: int) -> Any:
    return FACTORY.make(PUPPETS, header=make_header(FACTORY, stamp, "eye"))


def recorded(path: Path, topics: dict[str, tuple[str, Any]], count: int = 5) -> Path:
    """Record `count` messages of each topic (type, message of a stamp) at 20 Hz."""
    with BagWriter(path) as writer:
        for name, (kind, _) in topics.items():
            writer.add_topic(name, kind)
        for k in range(count):
            for name, (_, make) in topics.items():
                writer.write(name, 10**9 + k * STEP_NS, make(10**9 + k * STEP_NS))
    return path


def check_commands(found: Inspection) -> None:
    """Check that every command that was given can be typed."""
    for finding in found.findings:
        if finding.command.startswith("flowing-puppet"):
            check(shlex.split(finding.command))


def test_a_good_recording_has_nothing_wrong() -> None:
    found = inspect_input(GOLDEN)
    assert [finding.severity for finding in found.findings] == ["ready"] * 6
    assert {topic["name"] for topic in found.topics if topic["used_as"] == ["cam1/puppet_tracker: detections"]} == {
        "/cam1/detections"
    }
    rates = [topic["rate_hz"] for topic in found.topics if topic["name"].endswith("/image/compressed")]
    np.testing.assert_allclose(rates, 30.0, atol=0.1)  # the recipe of the bag says 30
    check_commands(found)


@pytest.mark.parametrize(
    ("topics", "severity", "words", "command"),
    [
        ({"/cam/image": (IMAGE, lambda t: picture(0))}, "warning", "/cam/image: all stamps are zero", ""),
        ({"/cam/image": (IMAGE, lambda t: picture(7))}, "warning", "/cam/image: all messages have one stamp", ""),
        ({"/cam/image": (IMAGE, lambda t: picture(2 * 10**9 - t))}, "warning", "100% of the stamps are before", ""),
        ({"/cam/image": (IMAGE, lambda t: picture(t, ""))}, "warning", "the frame_id is empty", ""),
        ({"/rgb": (IMAGE, picture)}, "error", "no topic can be used", "--topic-map /rgb:=/image"),
        ({"/cam/image": (IMAGE, picture), "/rgb": (IMAGE, picture)}, "note", "/rgb is not used", "/rgb:=/image"),
        ({"/d/depth": (IMAGE, depth)}, "error", "there is no /d/camera_info, nor any other", ""),
        (
            {"/d/depth": (IMAGE, depth), "/d/camera_info": (CAMERA_INFO, lambda t: info(t, 0 * K))},
            "error",
            "/d/depth: the camera_info is uncalibrated",
            "",
        ),
        (
            {"/d/depth": (IMAGE, depth), "/d/camera_info": (CAMERA_INFO, lambda t: info(t, width=128))},
            "error",
            "the depth image is 64x48, its camera_info says 128x48",
            "",
        ),
        (
            {"/points": (POINT_CLOUD, lambda t: cloud(t, 0))},
            "error",
            "/points: the first cloud has no finite point",
            "",
        ),
        (
            {"/c/image": (IMAGE, picture), "/c/detections": (PUPPETS, lambda t: detections(t + 10**12))},
            "warning",
            "the stamps on /c/image and /c/detections are 1e+03 s apart",
            "",
        ),
        (
            {"/points": (POINT_CLOUD, cloud), "/imu": ("sensor_msgs/msg/Imu", lambda t: FACTORY.make(IMU))},
            "note",
            "of no use here: /imu (sensor_msgs/msg/Imu)",
            "",
        ),
        ({"/points": (POINT_CLOUD, cloud)}, "ready", "bodies in the clouds on /points (5 messages, 20.0 Hz)", "replay"),
        (
            {"/d/depth": (IMAGE, depth), "/d/camera_info": (CAMERA_INFO, info)},
            "ready",
            "bodies in the depth images on /d/depth (5 messages, 20.0 Hz) with /d/camera_info",
            "replay",
        ),
    ],
)
def test_what_is_wrong_is_told_with_its_remedy(
    topics: dict[str, tuple[str, Any]], severity: str, words: str, command: str, tmp_path: Path
) -> None:
    found = inspect_input(recorded(tmp_path / "in.mcap", topics))
    matching = [finding for finding in found.findings if words in finding.sentence]
    assert matching, found.findings
    assert matching[0].severity == severity
    assert command in matching[0].command
    assert found.is_usable is (severity != "error")
    check_commands(found)


IMU = "sensor_msgs/msg/Imu"


def test_a_cut_recording_names_the_flag_that_reads_it(tmp_path: Path) -> None:
    cut = tmp_path / "cut off.mcap"
    cut.write_bytes(GOLDEN.read_bytes()[:100_000])
    found = inspect_input(cut)
    assert not found.is_usable
    assert found.findings[0].command == f"flowing-puppet doctor '{cut}' --salvage"
    salvaged = inspect_input(cut, salvage=True)
    assert salvaged.is_usable
    assert salvaged.findings[-1].command.endswith(" --salvage")
    check_commands(salvaged)


def test_the_verb_prints_json_and_its_status(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = recorded(tmp_path / "bad.mcap", {"/rgb": (IMAGE, picture)})
    assert main(["doctor", str(GOLDEN), str(bad), "--json"]) == 1
    good, wrong = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert (good["kind"], good["usable"], wrong["usable"]) == ("bag", True, False)
    assert wrong["findings"][0]["command"].endswith("--topic-map /rgb:=/image")
    assert main(["doctor", str(GOLDEN)]) == 0
    shown = capsys.readouterr().out
    assert shown.count("$ flowing-puppet replay") == 1
    assert main(["doctor", str(tmp_path / "none.mcap")]) == 2
