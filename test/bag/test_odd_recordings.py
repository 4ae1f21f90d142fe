# SPDX-License-Identifier: Apache-2.0
"""Replays of recordings that lack or damage something: said in one sentence, and the rest is used."""

import copy
import errno
import json
import re
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.replay.replay import ReplayOptions, replay
from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.cli import main
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.report.report import write_report
from flowing_puppet_ros.stream.messages.images import decode_image, make_image

pytestmark = pytest.mark.slow

FACTORY = BagMessageFactory()
IMAGE = "sensor_msgs/msg/Image"
QUIET = ReplayOptions(progress=False)


def excerpt(source: Path, target: Path, renamed: Mapping[str, str]) -> Path:
    """Copy some topics of a bag under new names."""
    with open_bag(source) as bag, BagWriter(target) as writer:
        for old, new in renamed.items():
            writer.add_topic(new, bag.topics[old], bag.details[old].qos)
        for record in bag.messages(renamed):
            writer.write_raw(renamed[record.topic], record.log_time, record.raw)
    return target


def payload(path: Path, topic: str) -> list[bytes]:
    with open_bag(path) as bag:
        return [record.raw for record in bag.messages([topic])]


def altered(source: Path, target: Path, change: Callable[[str, Any], Any], left_out: str = "none") -> Path:
    """Copy a bag with its messages changed; `change` returns a message, or bytes, or None to leave it out.

    Of the camera `left_out` there is nothing.
    """
    with open_bag(source) as bag, BagWriter(target) as writer:
        kept = [topic for topic in bag.topics if not topic.startswith(f"/{left_out}/")]
        for topic in kept:
            writer.add_topic(topic, bag.topics[topic], bag.details[topic].qos)
        for record in bag.messages(kept):
            message = change(record.topic, record.message)
            if isinstance(message, bytes):
                writer.write_raw(record.topic, record.log_time, message)
            elif message is not None:
                writer.write(record.topic, record.log_time, message)
    return target


def uncalibrated(topic: str, message: Any) -> Any:
    if topic == "/cam3/camera_info":
        message.k = np.zeros(9)
    return message


def no_rotation(topic: str, message: Any) -> Any:
    if topic == "/tf_static":
        q = message.transforms[2].transform.rotation
        q.x = q.y = q.z = q.w = 0.0
    return message


def no_info(topic: str, message: Any) -> Any:
    return None if topic == "/cam3/camera_info" else message


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (uncalibrated, r"without these cameras \(cam3: the camera_info is uncalibrated"),
        (no_rotation, r"without these cameras \(cam3: /tf_static has no transform to its frame 'cam3_optical_frame'"),
        (no_info, r"without these cameras \(cam3: there is no /cam3/camera_info"),
    ],
)
def test_a_camera_without_calibration_is_named_and_left_out_of_the_hull(
    change: Any, sentence: str, golden: Any, tmp_path: Path
) -> None:
    bag = altered(golden.source, tmp_path / "in.mcap", change, left_out="cam4")
    settings = {"visual_hull": {"hull_every": 7}, "body_fitter": {"fitter.local_iterations": 1, "fitter.restarts": 0}}
    summary = replay(bag, tmp_path / "out.mcap", ReplayOptions(settings=settings, progress=False))
    assert re.search(sentence, summary["warnings"][0])
    assert summary["messages"]["/hull"] == 1
    assert summary["messages"]["/cam3/puppets"] == 8


def test_why_there_is_no_hull_is_said(golden: Any, tmp_path: Path) -> None:
    def loop(topic: str, message: Any) -> Any:
        if topic == "/tf_static":
            back = copy.deepcopy(message.transforms[0])
            back.header.frame_id, back.child_frame_id = back.child_frame_id, back.header.frame_id
            message.transforms.append(back)
        return message

    bag = altered(golden.source, tmp_path / "in.mcap", loop)
    summary = replay(bag, tmp_path / "out.mcap", QUIET)
    (warning,) = summary["warnings"]
    assert "not built, it needs 2 cameras (cam1: the frames on /tf_static form a loop" in warning
    assert "/hull" not in summary["messages"]


def test_cameras_without_detections_are_named_with_the_way_out(golden: Any, tmp_path: Path) -> None:
    names = {"/cam1/image/compressed": "/robot/front/color/image_raw/compressed", "/cam1/detections": "/robot/people"}
    bag = excerpt(golden.source, tmp_path / "in.mcap", names)
    (warning,) = replay(bag, tmp_path / "out.mcap", QUIET)["warnings"]
    assert warning.startswith("the detector of this package finds the people in /robot/front/color/image_raw: ")
    rule = warning.partition("--topic-map ")[2].split()[0]
    old, new = rule.split(":=")
    again = replay(bag, tmp_path / "out.mcap", ReplayOptions(topic_map={old: new}, progress=False))
    assert again["warnings"] == []
    assert again["counters"]["robot/front/color/puppet_tracker"]["puppets"] > 0


def test_detections_of_another_type_feed_nothing(golden: Any, tmp_path: Path) -> None:
    with open_bag(golden.source) as bag, BagWriter(tmp_path / "in.mcap") as writer:
        writer.add_topic("/cam1/image/compressed", bag.topics["/cam1/image/compressed"])
        writer.add_topic("/cam1/detections", "geometry_msgs/msg/PoseArray")
        for record in bag.messages(["/cam1/image/compressed"]):
            poses = FACTORY.make("geometry_msgs/msg/PoseArray", header=record.message.header)
            writer.write("/cam1/detections", record.log_time, poses)
            writer.write_raw(record.topic, record.log_time, record.raw)
    summary = replay(tmp_path / "in.mcap", tmp_path / "out.mcap", QUIET)
    (warning,) = summary["warnings"]
    assert "on /cam1/detections, not geometry_msgs/msg/PoseArray" in warning
    assert summary["frames"] == 8


def test_what_was_recorded_of_the_results_is_made_anew(golden: Any, tmp_path: Path) -> None:
    with open_bag(golden.source) as given, open_bag(golden.replay) as made, BagWriter(tmp_path / "in.mcap") as to:
        topics = {**made.details, **given.details}
        for topic, detail in topics.items():
            to.add_topic(topic, detail.type, detail.qos)
        for bag, names in ((given, set(given.topics)), (made, set(made.topics) - set(given.topics))):
            for record in bag.messages(names):
                to.write_raw(record.topic, record.log_time, record.raw)
    options = ReplayOptions(settings={"visual_hull": {"hull_every": 4}}, progress=False)
    assert replay(tmp_path / "in.mcap", tmp_path / "out.mcap", options)["counters"] == golden.summary["counters"]
    assert payload(tmp_path / "out.mcap", "/bodies") == payload(golden.replay, "/bodies")


def test_an_image_that_was_also_recorded_compressed_is_used_once(golden: Any, tmp_path: Path) -> None:
    with open_bag(golden.source) as bag, BagWriter(tmp_path / "in.mcap") as writer:
        writer.add_topic("/cam1/image", IMAGE, "sensor")
        writer.add_topic("/cam1/image/compressed", bag.topics["/cam1/image/compressed"], "sensor")
        for record in bag.messages(["/cam1/image/compressed"]):
            picture = make_image(FACTORY, record.message.header, decode_image(record.message), "rgb8")
            writer.write("/cam1/image", record.log_time, picture)
            writer.write_raw(record.topic, record.log_time, record.raw)
    assert replay(tmp_path / "in.mcap", tmp_path / "out.mcap", QUIET)["frames"] == 8


def test_messages_that_are_not_what_they_claim_are_said_once_and_the_report_stands(golden: Any, tmp_path: Path) -> None:
    counts: Counter[str] = Counter()

    def spoil(topic: str, message: Any) -> Any:
        counts[topic] += 1
        spoiled = topic.startswith("/cam1/") and counts[topic] in (1, 4, 5)
        return b"\0\1\0\0\1" if spoiled else message if topic.startswith(("/cam1/", "/tf")) else None

    bag, out = altered(golden.source, tmp_path / "in.mcap", spoil), tmp_path / "out.mcap"
    summary = replay(bag, out, QUIET)
    assert sorted(text.split()[3] for text in summary["warnings"] if "claims to be" in text) == [
        "/cam1/detections",
        "/cam1/image/compressed",
    ]
    assert summary["frames"] == 5
    write_report(bag, out, tmp_path / "new" / "report.html", summary)
    assert "claims to be" in (tmp_path / "new" / "report.html").read_text()


def test_two_topics_cannot_get_one_name(golden: Any, tmp_path: Path) -> None:
    options = ReplayOptions(topic_map={"/cam1/image/compressed": "/cam2/detections"}, progress=False)
    with pytest.raises(InputError, match="gives two topics the name /cam2/detections"):
        replay(golden.source, tmp_path / "out.mcap", options)
    swapped = {"/cam1/detections": "/cam2/detections", "/cam2/detections": "/cam1/detections"}
    bag = excerpt(golden.source, tmp_path / "in.mcap", {name: name for name in (*swapped, "/cam1/image/compressed")})
    options = ReplayOptions(topic_map=swapped, progress=False)
    assert replay(bag, tmp_path / "out.mcap", options)["frames"] == 8


def test_the_output_is_never_put_into_the_input(golden: Any, tmp_path: Path) -> None:
    excerpt(golden.source, tmp_path / "bag", {"/cam1/image/compressed": "/cam1/image/compressed"})
    before = (tmp_path / "bag" / "bag_0.mcap").read_bytes()
    with pytest.raises(InputError, match="or in its folder"):
        replay(tmp_path / "bag", tmp_path / "bag" / "bag_0.mcap", QUIET)
    assert (tmp_path / "bag" / "bag_0.mcap").read_bytes() == before
    (tmp_path / "out.mcap").mkdir()
    with pytest.raises(InputError, match="it is a folder"):
        replay(tmp_path / "bag", tmp_path / "out.mcap", QUIET)


def test_results_are_named_though_the_report_cannot_be_written(
    golden: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = excerpt(golden.source, tmp_path / "in.mcap", {"/cam1/image/compressed": "/cam1/image/compressed"})
    words = ["replay", str(bag), "--out", str(tmp_path / "out.mcap"), "--report", str(tmp_path), "--json"]
    assert main(words) == 2
    said = capsys.readouterr()
    assert json.loads(said.out)["output"] == str(tmp_path / "out.mcap")
    assert "Is a directory; choose another path" in said.err


def test_a_full_disk_is_one_sentence(
    golden: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(BagWriter, "write", full)
    assert main(["replay", str(golden.source), "--out", str(tmp_path / "out.mcap")]) == 1
    assert capsys.readouterr().err.endswith("flowing-puppet replay: the work failed: No space left on device\n")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["- 1\n", "5\n", "a: [1\n", "puppet_tracker:\n  ros__parameters: {1: 2, x: 3}\n"])
def test_bad_parameter_files_are_one_sentence(text: str, golden: Any, tmp_path: Path) -> None:
    (tmp_path / "params.yaml").write_text(text)
    words = ["replay", str(golden.source), "--out", str(tmp_path / "out.mcap"), "--params"]
    assert main([*words, str(tmp_path / "params.yaml")]) == 2
