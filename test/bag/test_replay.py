# SPDX-License-Identifier: Apache-2.0
"""What a replay finds in a bag, is told, and refuses; and the command line around it."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.reader import Record, open_bag
from flowing_puppet_ros.bag.replay import replay as replay_module
from flowing_puppet_ros.bag.replay.replay import ReplayOptions, replay
from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.cli import main
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.ids import make_public_id
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header
from flowing_puppet_ros.stream.messages.images import make_image

FACTORY = BagMessageFactory()
IMAGE = "sensor_msgs/msg/Image"
QUIET = ReplayOptions(progress=False)


def excerpt(source: Path, target: Path, renamed: dict[str, str], before: int | None = None) -> Path:
    """Copy some topics of a bag under new names."""
    with open_bag(source) as bag, BagWriter(target) as writer:
        for old, new in renamed.items():
            writer.add_topic(new, bag.topics[old], bag.details[old].qos)
        for record in bag.messages(renamed):
            if before is None or record.log_time < before:
                writer.write_raw(renamed[record.topic], record.log_time, record.raw)
    return target


def without_ids(path: Path, topic: str) -> list[tuple[bytes, int]]:
    """Return the messages of a topic without the ids of people, which follow from the node's name, and their number."""
    found = []
    with open_bag(path) as bag:
        for record in bag.messages([topic]):
            ids = [puppet.id.encode() for puppet in record.message.puppets]
            raw = record.raw
            for identity in ids:
                raw = raw.replace(identity, b"?" * len(identity))
            found.append((raw, len(set(ids))))
    return found


def payload(path: Path, topic: str) -> list[bytes]:
    with open_bag(path) as bag:
        return [record.raw for record in bag.messages([topic])]


def test_one_camera_alone_is_tracked_and_topics_can_be_renamed(golden: Any, tmp_path: Path) -> None:
    names = {"/cam2/image/compressed": "/front/rgb/compressed", "/cam2/detections": "/keypoints"}
    bag = excerpt(golden.source, tmp_path / "in.mcap", names)
    rules = {"/front/rgb/compressed": "/robot/image/compressed", "/keypoints": "/robot/detections"}
    replay(bag, tmp_path / "out", ReplayOptions(topic_map=rules, progress=False))
    assert without_ids(tmp_path / "out", "/robot/puppets") == without_ids(golden.replay, "/cam2/puppets")
    assert payload(tmp_path / "out", "/robot/detections") == payload(golden.source, "/cam2/detections")


@pytest.mark.slow
def test_static_transforms_count_wherever_they_were_recorded(golden: Any, tmp_path: Path) -> None:
    with open_bag(golden.source) as bag, BagWriter(tmp_path / "late.mcap") as writer:
        two_cameras = [topic for topic in bag.topics if topic.startswith(("/cam1/", "/cam2/", "/tf"))]
        for topic in two_cameras:
            writer.add_topic(topic, bag.topics[topic], bag.details[topic].qos)
        for record in bag.messages(two_cameras):
            late = 10**12 if record.topic == "/tf_static" else 0
            writer.write_raw(record.topic, record.log_time + late, record.raw)
    settings = {"visual_hull": {"hull_every": 7}}
    replay(tmp_path / "late.mcap", tmp_path / "out.mcap", ReplayOptions(settings=settings, progress=False))
    assert len(payload(tmp_path / "out.mcap", "/hull")) == 1


@pytest.mark.slow
def test_fixed_frames_on_tf_are_static(golden: Any, tmp_path: Path) -> None:
    """As `tf` of ROS 1 publishes them: again and again on /tf, beside frames that move."""
    moving = FACTORY.make("geometry_msgs/msg/TransformStamped", child_frame_id="wheel")
    moving.header.frame_id, moving.transform.rotation.w = "cam1_optical_frame", 1.0
    topics = [f"/cam{k}/{name}" for k in (1, 2) for name in ("image/compressed", "detections", "camera_info")]
    with open_bag(golden.source) as bag, BagWriter(tmp_path / "in.mcap") as writer:
        (static,) = bag.messages(["/tf_static"])
        for topic in topics:
            writer.add_topic(topic, bag.topics[topic], bag.details[topic].qos)
        writer.add_topic("/tf", static.type)
        for record in bag.messages(topics):
            writer.write_raw(record.topic, record.log_time, record.raw)
            if record.topic == "/cam1/image/compressed":
                writer.write_raw("/tf", record.log_time, static.raw)
                moving.transform.translation.x += 0.1
                writer.write("/tf", record.log_time, FACTORY.make(static.type, transforms=[moving]))
    out = tmp_path / "out.mcap"
    summary = replay(
        tmp_path / "in.mcap", out, ReplayOptions(settings={"visual_hull": {"hull_every": 7}}, progress=False)
    )
    (warning,) = summary["warnings"]
    assert warning.endswith("on /tf never move: they are used as static") and "wheel" not in warning
    assert len(payload(out, "/hull")) == 1
    children = [item.child_frame_id for item in static.message.transforms]
    with open_bag(out) as made:
        (written,) = made.messages(["/tf_static"])
        assert [item.child_frame_id for item in written.message.transforms] == children


def test_a_salvaged_recording_gives_the_beginning_of_the_whole_one(golden: Any, tmp_path: Path) -> None:
    only = {f"/cam1/{name}": f"/cam1/{name}" for name in ("image/compressed", "detections", "camera_info")}
    whole = excerpt(golden.source, tmp_path / "in.mcap", only)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[:-40])
    with pytest.raises(InputError, match="--salvage"):
        replay(cut, tmp_path / "out.mcap", QUIET)
    assert not (tmp_path / "out.mcap").exists()
    replay(cut, tmp_path / "out.mcap", ReplayOptions(salvage=True, progress=False))
    assert payload(tmp_path / "out.mcap", "/cam1/puppets") == payload(golden.replay, "/cam1/puppets")


@pytest.mark.slow
def test_images_that_cannot_be_decoded_are_warned_of_once_and_the_run_goes_on(golden: Any, tmp_path: Path) -> None:
    with open_bag(golden.source) as bag, BagWriter(tmp_path / "in.mcap") as writer:
        writer.add_topic("/a/image", IMAGE, "sensor")
        writer.add_topic("/b/image/compressed", bag.topics["/cam1/image/compressed"], "sensor")
        for record in bag.messages(["/cam1/image/compressed"]):
            header = record.message.header
            image = make_image(FACTORY, header, np.zeros((32, 32), np.uint8), "thermal")
            writer.write("/a/image", record.log_time, image)
            writer.write_raw("/b/image/compressed", record.log_time, record.raw)
    summary = replay(tmp_path / "in.mcap", tmp_path / "out.mcap", QUIET)
    (warning,) = (text for text in summary["warnings"] if not text.startswith("the visual hull is not built"))
    assert "'thermal' is not one of rgb8" in warning
    assert summary["counters"]["a/puppet_tracker"]["unusable"] == 8
    assert summary["messages"]["/b/puppets"] == 8


def test_empty_clouds_are_warned_of_and_answered_with_no_body(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "in.mcap") as writer:
        writer.add_topic("/lidar/points", "sensor_msgs/msg/PointCloud2", "sensor")
        for k in range(2):
            cloud = make_cloud(FACTORY, make_header(FACTORY, k, "lidar"), np.zeros((0, 3)))
            writer.write("/lidar/points", k, cloud)
    summary = replay(tmp_path / "in.mcap", tmp_path / "out.mcap", QUIET)
    (warning,) = summary["warnings"]
    assert "the cloud has no finite point" in warning
    assert summary["messages"]["/lidar/bodies"] == 2


@pytest.mark.slow
def test_a_part_of_a_recording_is_replayed_by_the_times_of_recording(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "in.mcap") as writer:
        writer.add_topic("/lidar/points", "sensor_msgs/msg/PointCloud2", "sensor")
        for k in range(6):
            cloud = make_cloud(FACTORY, make_header(FACTORY, 10**9 * k, "lidar"), np.zeros((0, 3)))
            writer.write("/lidar/points", 10**12 + 10**9 * k, cloud)
    for start, length, expected in ((0.0, 2.0, [0, 1, 2]), (3.5, math.inf, [4, 5]), (1.0, 2.9, [1, 2, 3])):
        options = ReplayOptions(start_offset=start, playback_duration=length, progress=False)
        replay(tmp_path / "in.mcap", tmp_path / "out.mcap", options)
        with open_bag(tmp_path / "out.mcap") as out:
            stamps = [record.message.header.stamp.sec for record in out.messages(["/lidar/bodies"])]
        assert stamps == expected
        (tmp_path / "out.mcap").unlink()
    with pytest.raises(InputError, match=r"from second 7 on: it lasts 5\.0 s"):
        replay(tmp_path / "in.mcap", tmp_path / "out.mcap", ReplayOptions(start_offset=7.0, progress=False))
    assert not (tmp_path / "out.mcap").exists()


def test_a_bag_without_usable_topics_says_what_it_has(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "in.mcap") as writer:
        writer.add_topic("/imu", "sensor_msgs/msg/Imu")
        writer.add_topic("/thermal", IMAGE)
    with pytest.raises(InputError, match=r"the topics are /imu \(sensor_msgs/msg/Imu\), /thermal \(sensor_msgs/msg/Im"):
        replay(tmp_path / "in.mcap", tmp_path / "out.mcap", QUIET)


def test_the_input_is_never_the_output(golden: Any) -> None:
    with pytest.raises(InputError, match="is the input itself"):
        replay(golden.source, golden.source, QUIET)


def test_unknown_names_are_refused(golden: Any, tmp_path: Path) -> None:
    for options, sentence in (
        (ReplayOptions(topic_map={"/nothing": "/a"}), "names /nothing, but the topics are /cam1/camera_info"),
        (ReplayOptions(settings={"dancer": {}}), "no component 'dancer'"),
        (ReplayOptions(settings={"visual_hull": {"legs": 3}}), "unknown setting 'legs'"),
    ):
        with pytest.raises(InputError, match=sentence):
            replay(golden.source, tmp_path / "out.mcap", options)


def test_the_rate_paces_the_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [100.0]
    monkeypatch.setattr(replay_module.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(replay_module.time, "sleep", lambda seconds: clock.__setitem__(0, clock[0] + seconds))
    recording = [Record("/a", IMAGE, second * 10**9, b"") for second in (5, 6, 8)]
    assert [clock[0] for _ in replay_module.pace(iter(recording), 2.0)] == [100.0, 100.5, 101.5]
    assert [clock[0] for _ in replay_module.pace(iter(recording), 0.0)] == [101.5] * 3


def test_command_line_prints_one_json_object(golden: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = {f"/cam1/{name}": f"/cam1/{name}" for name in ("image/compressed", "detections")}
    bag = excerpt(golden.source, tmp_path / "in.mcap", names, before=1_600_000_000_050_000_000)
    params = tmp_path / "params.yaml"
    params.write_text("/**/puppet_tracker:\n  ros__parameters: {overlay_max_side: 64, queue: 3}\n")
    words = ["replay", str(bag), "--out", str(tmp_path / "out.mcap"), "--params", str(params), "--seed", "27", "--json"]
    assert main(words) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["frames"] == 2
    assert summary["settings"]["cam1/puppet_tracker"]["overlay_max_side"] == 64
    with open_bag(tmp_path / "out.mcap") as out:
        own = make_public_id("/cam1/puppet_tracker", "ab1")
        assert next(iter(out.messages(["/cam1/puppets"]))).message.puppets[0].id == own


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["missing.mcap", "--out", "x.mcap"], "there is no bag missing.mcap"),
        (["missing.mcap", "--out", "x.mcap", "--rate", "-1"], "--rate is -1"),
        (["missing.mcap", "--out", "x.mcap", "--start-offset", "-2"], "--start-offset is -2"),
        (["missing.mcap", "--out", "x.mcap", "--start-offset", "inf"], "--start-offset is inf"),
        (["missing.mcap", "--out", "x.mcap", "--playback-duration", "0"], "--playback-duration is 0"),
        (["missing.mcap", "--out", "x.mcap", "--playback-duration", "nan"], "--playback-duration is nan"),
        (["missing.mcap", "--out", "x.mcap", "--topic-map", "a=b"], "--topic-map is 'a=b': give /old:=/new"),
        (["missing.mcap", "--out", "x.mcap", "--params", "none.yaml"], "none.yaml cannot be read as YAML"),
    ],
)
def test_command_line_refuses_in_one_sentence(
    words: list[str], sentence: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["replay", *words]) == 2
    error = capsys.readouterr().err
    assert sentence in error
    assert error.count("\n") == 1
