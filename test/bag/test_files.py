# SPDX-License-Identifier: Apache-2.0
"""Bags written here are read by everybody, and broken ones end in one sentence."""

import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as OtherWriter

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.typestore import BagMessageFactory, typestore
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header

FACTORY = BagMessageFactory()
CLOUD = "sensor_msgs/msg/PointCloud2"
BODIES = "flowing_puppet_msgs/msg/BodyArray"


def cloud(k: Any) -> Any:
    """A cloud of noise that hardly compresses, so that files have several chunks."""
    points = np.random.default_rng(k).normal(size=(30_000, 3))
    return make_cloud(FACTORY, make_header(FACTORY, k, "lidar"), points)


def write(path: Path, count: int = 8) -> Any:
    """Write clouds and bodies, the second half of the bodies out of log order."""
    with BagWriter(path) as writer:
        writer.add_topic("/points", CLOUD, "sensor")
        writer.add_topic("/bodies", BODIES, "latched")
        writer.add_topic("/silent", BODIES)
        for k in range(count):
            writer.write("/points", 1000 * k, cloud(k))
        for k in range(count):
            bodies = FACTORY.make(BODIES, header=make_header(FACTORY, k, "lidar"))
            writer.write("/bodies", 1000 * k + 500, bodies)
    return path


@pytest.fixture(scope="module")
def bag(tmp_path_factory: Any) -> Any:
    return write(tmp_path_factory.mktemp("bag") / "a.mcap")


def summary(path: Path, **options: Any) -> Any:
    with open_bag(path, **options) as opened:
        return [(r.topic, r.log_time, r.raw) for r in opened.messages()]


def test_messages_come_in_log_order_and_unchanged(bag: Any) -> None:
    with open_bag(bag) as opened:
        assert opened.topics == {"/points": CLOUD, "/bodies": BODIES, "/silent": BODIES}
        assert opened.count == 16
        records = list(opened.messages())
        assert [r.log_time for r in records] == [500 * k for k in range(16)]
        np.testing.assert_array_equal(records[4].message.data, cloud(2).data)
        assert [r.topic for r in opened.messages(["/bodies"])] == ["/bodies"] * 8
        assert list(opened.messages(["/other"])) == []


def test_folder_and_file_hold_the_same_and_every_writing_gives_the_same_bytes(bag: Any, tmp_path: Path) -> None:
    folder = write(tmp_path / "b")
    assert (folder / "b_0.mcap").read_bytes() == write(tmp_path / "c" / "b").joinpath("b_0.mcap").read_bytes()
    assert summary(folder) == summary(bag)
    (folder / "metadata.yaml").unlink()
    assert summary(folder) == summary(bag)


def test_other_readers_read_it(bag: Any, tmp_path: Path) -> None:
    for path in (bag, write(tmp_path / "b")):
        with AnyReader([path]) as reader:
            found: list[Any] = [(c.topic, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]
            connections: list[Any] = list(reader.connections)
            qos = {c.topic: c.ext.offered_qos_profiles[0] for c in connections}
        assert len(found) == 16
        np.testing.assert_array_equal(found[0][2].data, cloud(0).data)
        assert qos["/bodies"].durability == QosDurability.TRANSIENT_LOCAL
        assert qos["/points"].reliability == QosReliability.BEST_EFFORT
    with bag.open("rb") as stream:
        other: Any = make_reader(stream, validate_crcs=True)
        facts = other.get_summary()
        assert other.get_header().profile == "ros2"
        assert facts.statistics.message_count == len(list(other.iter_messages())) == 16
        assert {chunk.compression for chunk in facts.chunk_indexes} == {"zstd"}
        assert {channel.message_encoding for channel in facts.channels.values()} == {"cdr"}
        assert {schema.encoding for schema in facts.schemas.values()} == {"ros2msg"}


@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_bags_of_other_writers_are_read(plugin: Any, tmp_path: Path) -> None:
    store = typestore()
    with OtherWriter(tmp_path / "other", version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection("/points", CLOUD, typestore=store)
        for k in range(3):
            writer.write(connection, k, bytes(store.serialize_cdr(cloud(k), CLOUD)))
    found = summary(tmp_path / "other")
    assert [(topic, log_time) for topic, log_time, _ in found] == [("/points", k) for k in range(3)]
    suffix = {StoragePlugin.SQLITE3: "db3", StoragePlugin.MCAP: "mcap"}[plugin]
    assert summary(next((tmp_path / "other").glob(f"*.{suffix}"))) == found


def test_a_truncated_file_names_the_way_out_and_is_salvaged(bag: Any, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    whole = bag.read_bytes()
    cut.write_bytes(whole[: len(whole) * 6 // 10])
    with pytest.raises(InputError, match=r"cut.mcap is cut off before its end: add --salvage"):
        open_bag(cut)
    saved = summary(cut, salvage=True)
    points = [record for record in summary(bag) if record[0] == "/points"]
    assert 2 <= len(saved) < 8
    assert saved == points[: len(saved)]
    assert summary(bag, salvage=True) == summary(bag)


@pytest.mark.parametrize("metadata", [True, False])
def test_a_truncated_file_in_a_folder_is_salvaged_too(tmp_path: Path, metadata: bool) -> None:
    folder = write(tmp_path / "b")
    cut = folder / "b_0.mcap"
    cut.write_bytes(cut.read_bytes()[:-50])
    if not metadata:
        (folder / "metadata.yaml").unlink()
    with pytest.raises(InputError, match=r"b_0.mcap is cut off before its end: add --salvage"):
        open_bag(folder)
    assert len(summary(folder, salvage=True)) == 16


@pytest.mark.parametrize("keep", [0, 3, 8, 12, 60])
def test_next_to_nothing_left_is_no_traceback(bag: Any, tmp_path: Path, keep: Any) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(bag.read_bytes()[:keep])
    with pytest.raises(InputError):
        open_bag(cut)
    with pytest.raises(InputError):
        open_bag(cut, salvage=True)


def database(path: Path) -> None:
    sqlite3.connect(path).execute("create table cats (name text)").connection.commit()


@pytest.mark.parametrize(
    ("name", "make", "sentence"),
    [
        ("missing.mcap", lambda path: None, "there is no bag"),
        ("text.mcap", lambda path: path.write_text("hello"), "is not a readable ROS 2 bag"),
        ("text.txt", lambda path: path.write_text("hello"), "is not a readable ROS 2 bag"),
        ("empty.mcap", lambda path: path.touch(), "is not a readable ROS 2 bag"),
        ("cats.db3", database, "is not a readable ROS 2 bag"),
        ("folder", lambda path: path.mkdir(), "has no metadata.yaml and 0 bag files"),
    ],
)
def test_what_is_no_bag_is_refused_in_one_sentence(tmp_path: Path, name: Any, make: Any, sentence: Any) -> None:
    make(tmp_path / name)
    with pytest.raises(InputError, match=sentence):
        open_bag(tmp_path / name)


def test_damage_in_the_middle_is_one_sentence(bag: Any, tmp_path: Path) -> None:
    damaged = bytearray(bag.read_bytes())
    damaged[len(damaged) // 2 : len(damaged) // 2 + 400] = bytes(400)
    (tmp_path / "bad.mcap").write_bytes(damaged)
    with pytest.raises(InputError, match=r"bad.mcap is damaged"):
        summary(tmp_path / "bad.mcap")


def test_bytes_that_are_no_message_are_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap") as writer:
        writer.add_topic("/bodies", BODIES)
        writer.write_raw("/bodies", 0, b"\x00\x01\x00\x00\xff\xff")
    with open_bag(tmp_path / "a.mcap") as opened, pytest.raises(InputError, match="a message on /bodies is not the"):
        _ = next(iter(opened.messages())).message


def test_places_that_cannot_be_written_are_refused(tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").touch()
    with pytest.raises(InputError, match="is not empty"):
        BagWriter(tmp_path / "full")
    with pytest.raises(InputError, match="cannot write the bag"):
        BagWriter(tmp_path / "full" / "x" / "a.mcap")


def test_an_interrupted_writing_leaves_no_bag(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), BagWriter(tmp_path / "a.mcap") as writer:
        writer.add_topic("/bodies", BODIES)
        raise RuntimeError
    assert not (tmp_path / "a.mcap").exists()
