# SPDX-License-Identifier: Apache-2.0
"""ROS 1 bags, MCAP files with ROS 1 messages, and definitions of other versions, as ROS 2 messages."""

from __future__ import annotations

import gzip
import sqlite3
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from flowing_puppet_ros.bag.foreign.ros_types import normalise_type
from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.typestore import BagMessageFactory, typestore
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.clouds import decode_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header
from flowing_puppet_ros.stream.messages.images import decode_image
from flowing_puppet_ros.stream.messages.message_types import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    POINT_CLOUD,
    TRANSFORMS,
)
from test.helpers.definitions import HEADER

ROS1 = get_typestore(Stores.ROS1_NOETIC)
OLD_TRANSFORMS = "tf/msg/tfMessage"
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", OLD_TRANSFORMS))
T: Any = ROS1.types
PIXELS = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
POINTS = np.array([[1.0, 2, 3], [-4, 5, 6]], np.float32)
K = np.array([500.0, 0, 2, 0, 501, 1, 0, 0, 1])


def header(k: int) -> Any:
    time = T["builtin_interfaces/msg/Time"](sec=1_500_000_000, nanosec=k)
    return T["std_msgs/msg/Header"](seq=7, stamp=time, frame_id="/eye")


def image(k: int) -> Any:
    return T[IMAGE](header(k), 2, 4, "rgb8", 0, 12, PIXELS.reshape(-1) + np.uint8(k))


def info(k: int) -> Any:
    roi = T["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    return T[CAMERA_INFO](header(k), 2, 4, "plumb_bob", np.zeros(5), K, np.eye(3).ravel(), np.arange(12.0), 0, 0, roi)


def cloud(k: int) -> Any:
    fields = [T["sensor_msgs/msg/PointField"](name, 4 * place, 7, 1) for place, name in enumerate("xyz")]
    return T[POINT_CLOUD](header(k), 1, 2, fields, False, 12, 24, POINTS.view(np.uint8).reshape(-1), True)


def transforms(k: int) -> Any:
    vector, turn = T["geometry_msgs/msg/Vector3"](1.0, 2.0, 3.0), T["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.6, 0.8)
    moved = T["geometry_msgs/msg/Transform"](vector, turn)
    return T[OLD_TRANSFORMS]([T["geometry_msgs/msg/TransformStamped"](header(k), "eye", moved)])


MAKERS = {"/eye/image_raw": (IMAGE, image), "/eye/camera_info": (CAMERA_INFO, info), "/points": (POINT_CLOUD, cloud)}


def written(path: Path, compression: Writer.CompressionFormat | None = None, count: int = 4) -> Path:
    """Write a ROS 1 bag with a chunk for every few messages."""
    writer = Writer(path)
    if compression:
        writer.set_compression(compression)
    writer.chunk_threshold = 700
    with writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=ROS1) for topic, (kind, _) in MAKERS.items()}
        old = writer.add_connection("/tf_static", OLD_TRANSFORMS, typestore=ROS1)
        for k in range(count):
            for topic, (kind, make) in MAKERS.items():
                writer.write(connections[topic], 1000 * k, bytes(ROS1.serialize_ros1(make(k), kind)))
            writer.write(old, 1000 * k, bytes(ROS1.serialize_ros1(transforms(k), OLD_TRANSFORMS)))
    return path


def check(path: Path, count: int = 4, salvage: bool = False) -> list[str]:
    """Check all messages of a bag and return its notes."""
    with open_bag(path, salvage) as bag:
        assert bag.topics == {topic: kind for topic, (kind, _) in MAKERS.items()} | {"/tf_static": TRANSFORMS}
        found: dict[str, list[Any]] = {topic: [] for topic in bag.topics}
        times = []
        for record in bag.messages():
            found[record.topic].append(record.message)
            times.append(record.log_time)
        assert {topic: len(messages) for topic, messages in found.items()} == dict.fromkeys(bag.topics, count)
        assert times == sorted(times)
        notes = bag.notes
    for k in range(count):
        picture, camera, points, moved = (found[topic][k] for topic in [*MAKERS, "/tf_static"])
        for message in (picture, camera, points, moved.transforms[0]):
            assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_500_000_000, k)
            assert message.header.frame_id == "/eye"
        np.testing.assert_array_equal(decode_image(picture), PIXELS + np.uint8(k))
        assert (camera.width, camera.height, camera.distortion_model) == (4, 2, "plumb_bob")
        np.testing.assert_array_equal(camera.k, K)
        np.testing.assert_array_equal(camera.p, np.arange(12.0))
        np.testing.assert_array_equal(decode_cloud(points)[0], POINTS)
        shift, turn = moved.transforms[0].transform.translation, moved.transforms[0].transform.rotation
        assert (shift.x, shift.y, shift.z, turn.z, turn.w) == (1.0, 2.0, 3.0, 0.6, 0.8)
    return list(notes)


@pytest.mark.parametrize("compression", [None, Writer.CompressionFormat.BZ2, Writer.CompressionFormat.LZ4])
def test_ros1_bags_are_read(compression: Any, tmp_path: Path) -> None:
    path = written(tmp_path / "a.bag", compression)
    assert check(path) == []
    assert check(path, salvage=True) == [f"{path}: 16 messages salvaged"]


def test_compressed_and_renamed_ros1_bags_are_read(tmp_path: Path) -> None:
    path = written(tmp_path / "a.bag")
    (tmp_path / "a.bag.gz").write_bytes(gzip.compress(path.read_bytes()))
    assert check(tmp_path / "a.bag.gz") == []
    assert check(path.rename(tmp_path / "recording")) == []


def test_splits_of_ros1_are_one_bag(tmp_path: Path) -> None:
    written(tmp_path / "a.bag")
    (tmp_path / "drive").mkdir()
    for number in (0, 1):
        (tmp_path / "drive" / f"lab_2019-05-03-12-41-3{number}_{number}.bag").write_bytes(
            (tmp_path / "a.bag").read_bytes()
        )
    with open_bag(tmp_path / "drive") as bag:
        assert bag.details["/points"].count == len(list(bag.messages(["/points"]))) == 8


def test_ros1_bags_that_were_not_closed_are_salvaged(tmp_path: Path) -> None:
    path = written(tmp_path / "a.bag")
    data = path.read_bytes()
    head = struct.pack("<I", len(b"index_pos=") + 8) + b"index_pos="
    place = data.index(head) + len(head)
    (index,) = struct.unpack_from("<Q", data, place)
    active = tmp_path / "a.bag.active"
    active.write_bytes(data[:place] + bytes(8) + data[place + 8 : index])
    with pytest.raises(InputError, match=r"a.bag.active was not closed, is cut off or damaged: add --salvage"):
        open_bag(active)
    assert check(active, salvage=True) == [f"{active}: 16 messages salvaged"]


@pytest.mark.parametrize("compression", [None, Writer.CompressionFormat.BZ2])
def test_ros1_bags_cut_or_damaged_keep_what_is_whole(compression: Any, tmp_path: Path) -> None:
    path = written(tmp_path / "a.bag", compression, count=12)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 4 // 10])
    with open_bag(path, salvage=True) as bag:
        stamps = [record.message.header.stamp.nanosec for record in bag.messages(["/points"])]
    assert 2 <= len(stamps) < 12 and stamps == list(range(len(stamps)))
    for cut in (5, 20, 60, 4200):
        path.write_bytes(data[:cut])
        with pytest.raises(InputError):
            open_bag(path)


def mcap(path: Path, kind: str, encoding: str, schema: tuple[str, str], messages: list[bytes], profile: str) -> Path:
    with path.open("wb") as stream:
        writer = McapWriter(stream, compression=CompressionType.NONE)
        writer.start(profile=profile, library="other")
        number = writer.register_schema(kind, schema[0], schema[1].encode())
        channel = writer.register_channel("/eye/image_raw", encoding, number, {})
        for k, data in enumerate(messages):
            writer.add_message(channel, 1000 * k, data, 1000 * k, k)
        writer.finish()
    return path


@pytest.mark.parametrize("profile", ["ros1", "", "ros2"])
def test_mcap_files_with_ros1_messages_are_read(profile: str, tmp_path: Path) -> None:
    messages = [bytes(ROS1.serialize_ros1(image(k), IMAGE)) for k in range(3)]
    schema = ("ros1msg", ROS1.generate_msgdef(IMAGE)[0])
    path = mcap(tmp_path / "a.mcap", "sensor_msgs/Image", "ros1", schema, messages, profile)
    with open_bag(path) as bag:
        assert bag.topics == {"/eye/image_raw": IMAGE}
        for k, record in enumerate(bag.messages()):
            np.testing.assert_array_equal(decode_image(record.message), PIXELS + np.uint8(k))
            assert record.message.header.stamp.nanosec == k


@pytest.mark.parametrize("kind", ["sensor_msgs/Image", "sensor_msgs::msg::Image", "sensor_msgs::msg::dds_::Image_"])
def test_types_are_known_however_they_are_written(kind: str, tmp_path: Path) -> None:
    factory = BagMessageFactory()
    picture = factory.make(IMAGE, height=2, width=4, encoding="rgb8", step=12, data=PIXELS)
    schema = ("ros2msg", typestore().generate_msgdef(IMAGE, ros_version=2)[0])
    data = bytes(typestore().serialize_cdr(picture, IMAGE))
    with open_bag(mcap(tmp_path / "a.mcap", kind, "cdr", schema, [data], "ros2")) as bag:
        assert bag.topics == {"/eye/image_raw": IMAGE}
        (record,) = bag.messages()
        assert record.raw == data
        np.testing.assert_array_equal(decode_image(record.message), PIXELS)


def test_names_that_are_no_ros_types_stay() -> None:
    assert normalise_type("foxglove.Log") == "foxglove.Log"
    assert normalise_type("sensor_msgs.msg.Image") == IMAGE
    assert normalise_type("a.b.Log") == "a.b.Log"
    assert normalise_type("Log") == "Log"
    assert normalise_type("tf/tfMessage") == TRANSFORMS


def test_messages_of_another_version_are_read_by_the_definition_in_the_file(tmp_path: Path) -> None:
    # Another order, a field more, and one less (step).
    text = (
        """std_msgs/Header header
string encoding
uint32 width
uint32 height
float64 exposure
uint8[] data
uint8 is_bigendian
"""
        + HEADER
    )
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, IMAGE))
    types: Any = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=3, nanosec=4)
    old = types[IMAGE](types["std_msgs/msg/Header"](stamp, "eye"), "rgb8", 4, 2, 0.5, PIXELS.reshape(-1), 0)
    data = bytes(store.serialize_cdr(old, IMAGE))
    with open_bag(mcap(tmp_path / "a.mcap", IMAGE, "cdr", ("ros2msg", text), [data], "ros2")) as bag:
        (message,) = (record.message for record in bag.messages())
    assert (message.header.stamp.sec, message.header.frame_id, message.encoding) == (3, "eye", "rgb8")
    assert (message.width, message.height, message.step) == (4, 2, 0)
    np.testing.assert_array_equal(message.data, PIXELS.reshape(-1))


def test_compressed_images_of_ros1_keep_their_bytes(tmp_path: Path) -> None:
    message = T[COMPRESSED_IMAGE](header(1), "jpeg", np.arange(50, dtype=np.uint8))
    with Writer(tmp_path / "a.bag") as writer:
        connection = writer.add_connection("/eye/image_raw/compressed", COMPRESSED_IMAGE, typestore=ROS1)
        writer.write(connection, 5, bytes(ROS1.serialize_ros1(message, COMPRESSED_IMAGE)))
        writer.write(connection, 6, b"\x01\x02")
    with open_bag(tmp_path / "a.bag") as bag:
        good, bad = bag.messages()
    np.testing.assert_array_equal(good.message.data, np.arange(50))
    with pytest.raises(InputError, match="a message on /eye/image_raw/compressed is not the sensor_msgs/msg/Compr"):
        _ = bad.message


def test_clouds_of_the_first_years_are_read(tmp_path: Path) -> None:
    kind = "sensor_msgs/msg/PointCloud"
    points = [T["geometry_msgs/msg/Point32"](*map(float, point)) for point in POINTS]
    with Writer(tmp_path / "a.bag") as writer:
        connection = writer.add_connection("/points", kind, typestore=ROS1)
        writer.write(connection, 5, bytes(ROS1.serialize_ros1(T[kind](header(3), points, []), kind)))
    # A database of an older recorder has no definitions.
    new, factory = typestore(), BagMessageFactory()
    points = [factory.make("geometry_msgs/msg/Point32", x=x, y=y, z=z) for x, y, z in POINTS.tolist()]
    message = factory.make(kind, header=make_header(factory, 1_500_000_000 * 10**9 + 3, "/eye"), points=points)
    with Rosbag2Writer(tmp_path / "b", version=9, storage_plugin=StoragePlugin.SQLITE3) as other:
        connection = other.add_connection("/points", kind, typestore=new)
        other.write(connection, 5, bytes(new.serialize_cdr(message, kind)))
    with sqlite3.connect(tmp_path / "b" / "b.db3") as database:
        database.execute("delete from message_definitions")
    for name in ("a.bag", "b"):
        with open_bag(tmp_path / name) as bag:
            assert bag.topics == {"/points": POINT_CLOUD}
            (record,) = bag.messages()
        np.testing.assert_array_equal(decode_cloud(record.message)[0], POINTS)
        assert (record.message.header.stamp.nanosec, record.message.header.frame_id) == (3, "/eye")
