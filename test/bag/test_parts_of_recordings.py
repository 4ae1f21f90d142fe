# SPDX-License-Identifier: Apache-2.0
"""Recordings of which a part was not written, is gone, renamed or compressed: what is there is read, the rest told."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as OtherWriter
from ruamel.yaml import YAML

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.typestore import BagMessageFactory, typestore
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header

FACTORY = BagMessageFactory()
BODIES, CLOUD = "flowing_puppet_msgs/msg/BodyArray", "sensor_msgs/msg/PointCloud2"


def message(k: int) -> bytes:
    bodies = FACTORY.make(BODIES, header=make_header(FACTORY, k, f"frame_{k}"))
    return bytes(typestore().serialize_cdr(bodies, BODIES))


def wanted(*numbers: int) -> list[tuple[int, bytes]]:
    return [(1000 * k, message(k)) for k in numbers]


def read(path: Path, salvage: bool = False) -> tuple[list[tuple[int, bytes]], list[str]]:
    """Return (log time, bytes) of all messages, and the notes."""
    with open_bag(path, salvage) as bag:
        assert all(kind == BODIES for kind in bag.topics.values())
        return [(record.log_time, record.raw) for record in bag.messages()], bag.notes


def database(folder: Path, numbers: range = range(3)) -> Path:
    """Write a rosbag2 folder with one database, and return the database."""
    with OtherWriter(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/bodies", BODIES, typestore=typestore())
        for k in numbers:
            writer.write(connection, 1000 * k, message(k))
    return next(folder.glob("*.db3"))


def parts(folder: Path, count: int = 3, name: str = "a") -> list[Path]:
    """Write `count` splits of two messages each."""
    folder.mkdir(exist_ok=True)
    paths = [folder / f"{name}_{part}.mcap" for part in range(count)]
    for part, path in enumerate(paths):
        with BagWriter(path) as writer:
            writer.add_topic("/bodies", BODIES)
            for k in (2 * part, 2 * part + 1):
                writer.write_raw("/bodies", 1000 * k, message(k))
    return paths


def describe(folder: Path, names: list[str], **changes: Any) -> None:
    """Write a metadata.yaml that lists `names`."""
    topic = {"name": "/bodies", "type": BODIES, "serialization_format": "cdr", "offered_qos_profiles": ""}
    about = {
        "version": 5,
        "storage_identifier": "mcap",
        "relative_file_paths": names,
        "duration": {"nanoseconds": 1},
        "starting_time": {"nanoseconds_since_epoch": 0},
        "message_count": 1,
        "topics_with_message_count": [{"topic_metadata": topic, "message_count": 1}],
        "compression_format": "",
        "compression_mode": "",
    }
    YAML().dump({"rosbag2_bagfile_information": about | changes}, folder / "metadata.yaml")


def killed_recorder(folder: Path, mode: str, commit: bool) -> Path:
    """Return a copy of a database as a recorder that was killed leaves it: two messages more, committed or not."""
    path = database(folder / "live")
    connection = sqlite3.connect(path)
    connection.execute(f"pragma journal_mode={mode}")
    connection.execute("pragma cache_size=1")
    for k in (3, 4):
        connection.execute("insert into messages (topic_id, timestamp, data) values (1, ?, ?)", (1000 * k, message(k)))
    # Spills the cache, so that the file has been written to when the recorder dies.
    connection.execute("create table filler (data blob)")
    connection.executemany("insert into filler values (?)", [(bytes(5000),)] * 20)
    if commit:
        connection.commit()
    (folder / "dead").mkdir()
    for file in (folder / "live").iterdir():
        if not file.name.endswith("-shm"):
            shutil.copyfile(file, folder / "dead" / file.name)
    connection.close()
    return folder / "dead" / path.name


@pytest.mark.parametrize("whole_folder", [True, False])
def test_what_is_still_in_the_write_ahead_log_is_read(whole_folder: bool, tmp_path: Path) -> None:
    path = killed_recorder(tmp_path, "wal", commit=True)
    before = {file: file.read_bytes() for file in path.parent.iterdir()}
    assert any(file.name.endswith("-wal") and data for file, data in before.items())
    found, notes = read(path.parent if whole_folder else path)
    assert found == wanted(0, 1, 2, 3, 4)
    assert notes == [f"{path} was not closed by its recorder: it is read together with {path.name}-wal"]
    assert {file: file.read_bytes() for file in path.parent.iterdir()} == before, "recordings are not written to"


def test_what_was_not_committed_is_taken_back(tmp_path: Path) -> None:
    path = killed_recorder(tmp_path, "delete", commit=False)
    assert path.with_name(f"{path.name}-journal").stat().st_size
    assert read(path)[0] == wanted(0, 1, 2)


def test_a_damaged_database_is_named_with_the_way_out(tmp_path: Path) -> None:
    path = database(tmp_path / "a", range(400))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match=r"a.db3 is damaged: .*; `sqlite3 .*a.db3. .recover \| sqlite3 rescued.db3`"):
        read(path)


@pytest.mark.parametrize("name", ["a #1.db3", "what?.db3", "50%41.db3"])
def test_databases_may_have_any_name(name: str, tmp_path: Path) -> None:
    path = database(tmp_path / "a").rename(tmp_path / name)
    assert read(path) == (wanted(0, 1, 2), [])


@pytest.mark.parametrize(
    ("listed", "there", "numbers", "note"),
    [
        (["a_0", "a_1"], ["a_0", "a_1", "a_2"], range(6), "metadata.yaml does not list a_2.mcap, which is read too"),
        (
            ["a_0", "a_1", "a_2"],
            ["a_0", "a_2"],
            [0, 1, 4, 5],
            "lists a_1.mcap, which is gone, its messages are missing",
        ),
        (["a_0", "a_1"], ["a_0", "take"], range(4), "lists a_1.mcap, which is gone; instead take.mcap is read"),
        (["x_0", "x_1"], ["a_0", "a_1"], range(4), "x_0.mcap, x_1.mcap, which is gone; instead a_0.mcap, a_1.mcap is"),
        (["a_0"], ["a_0", "other"], range(2), "other.mcap is not part of the recording and not read"),
        (["old/a_0", "old/a_1"], ["a_0", "a_1"], range(4), ""),
    ],
)
def test_metadata_that_lists_other_files_than_there_are(
    listed: list[str], there: list[str], numbers: Any, note: str, tmp_path: Path
) -> None:
    written = {path.stem: path for path in parts(tmp_path / "all")}
    (tmp_path / "a").mkdir()
    for stem in there:
        source = written.get(stem, written["a_1"])
        shutil.copyfile(source, tmp_path / "a" / f"{stem}.mcap")
    describe(tmp_path / "a", [f"{name}.mcap" for name in listed])
    for salvage in (False, True):
        found, notes = read(tmp_path / "a", salvage)
        assert found == wanted(*numbers)
        said = [text for text in notes if "salvaged" not in text]
        assert (note in said[0] and len(said) == 1) if note else not said


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "is empty"),
        ("# nothing\n", "is empty"),
        ("a: [1\n", "cannot be read as YAML"),
        ("\xff\xfe", "is not that of a rosbag2 bag"),
        ("- 1\n", "is not that of a rosbag2 bag"),
        ("camera:\n  width: 640\n", "is not that of a rosbag2 bag"),
        ("rosbag2_bagfile_information:\n  version: 5\n", "is not that of a rosbag2 bag"),
    ],
)
def test_without_readable_metadata_all_files_are_read(text: str, problem: str, tmp_path: Path) -> None:
    parts(tmp_path / "a")
    (tmp_path / "a" / "metadata.yaml").write_text(text, "utf8")
    found, notes = read(tmp_path / "a")
    assert found == wanted(*range(6))
    assert notes == [f"{tmp_path / 'a' / 'metadata.yaml'} {problem}: all files beside it are read"]


@pytest.mark.parametrize(
    "changes",
    [
        {"version": 10, "invented": {"later": True}},
        {"storage_identifier": "another"},
        {"topics_with_message_count": None},
        {"topics_with_message_count": [{"topic_metadata": {"name": "/bodies"}}, 3]},
        {"compression_mode": "FILE", "compression_format": "zstd"},
        {"duration": None, "message_count": "many"},
    ],
)
def test_newer_and_wrong_metadata_do_not_matter(changes: dict[str, Any], tmp_path: Path) -> None:
    paths = parts(tmp_path / "a")
    describe(tmp_path / "a", [path.name for path in paths], **changes)
    assert read(tmp_path / "a") == (wanted(*range(6)), [])


def test_topics_without_messages_are_known_from_the_metadata(tmp_path: Path) -> None:
    paths = parts(tmp_path / "a")
    topic = {"name": "/points", "type": CLOUD, "serialization_format": "cdr", "offered_qos_profiles": ""}
    entry = {"topic_metadata": topic, "message_count": 0}
    describe(tmp_path / "a", [path.name for path in paths], topics_with_message_count=[entry])
    with open_bag(tmp_path / "a") as bag:
        assert {name: (one.type, one.count) for name, one in bag.details.items()} == {
            "/bodies": (BODIES, 6),
            "/points": (CLOUD, 0),
        }


def test_a_split_that_was_only_begun_is_told_of(tmp_path: Path) -> None:
    parts(tmp_path / "a")
    (tmp_path / "a" / "a_3.mcap").touch()
    assert read(tmp_path / "a") == (wanted(*range(6)), [f"{tmp_path / 'a' / 'a_3.mcap'} is empty"])


@pytest.mark.parametrize("name", ["recording", "recording.bin", "a.db3", "a.bag", "a.MCAP", "a.mcap.part"])
def test_files_are_known_by_their_content(name: str, tmp_path: Path) -> None:
    path = parts(tmp_path / "a", 1)[0].rename(tmp_path / name)
    assert read(path) == (wanted(0, 1), [])
    path = database(tmp_path / "b").rename(tmp_path / name)
    assert read(path) == (wanted(0, 1, 2), [])


PACKERS: dict[str, Callable[[bytes], bytes]] = {
    "zst": zstandard.compress, "zstd": zstandard.compress, "lz4": lz4.frame.compress, "gz": gzip.compress,
    "bz2": bz2.compress, "xz": lzma.compress,
}  # fmt: skip


@pytest.mark.parametrize("suffix", PACKERS)
def test_compressed_files_are_read(suffix: str, tmp_path: Path) -> None:
    for path, numbers in ((parts(tmp_path / "a", 1)[0], range(2)), (database(tmp_path / "b"), range(3))):
        packed = tmp_path / f"{path.name}.{suffix}"
        data = path.read_bytes()
        packed.write_bytes(PACKERS[suffix](data))
        assert read(packed) == (wanted(*numbers), [])
        # A program that compresses in parallel writes several frames.
        packed.write_bytes(PACKERS[suffix](data[:100]) + PACKERS[suffix](data[100:]))
        assert read(packed) == (wanted(*numbers), [])


def test_compressed_files_that_end_too_early(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(30_000, 3))
    with BagWriter(tmp_path / "a.mcap") as writer:
        writer.add_topic("/points", CLOUD)
        for k in range(8):
            writer.write("/points", 1000 * k, make_cloud(FACTORY, make_header(FACTORY, k, "lidar"), points + k))
    packed = tmp_path / "a.mcap.zst"
    whole = zstandard.compress((tmp_path / "a.mcap").read_bytes())
    packed.write_bytes(whole[: len(whole) * 6 // 10])
    with pytest.raises(InputError, match=r"a.mcap.zst is cut off or damaged, its zstd data ends too early: add --salv"):
        open_bag(packed)
    with open_bag(packed, salvage=True) as bag:
        stamps = [record.message.header.stamp.nanosec for record in bag.messages()]
        assert stamps == list(range(len(stamps))) and 3 <= len(stamps) < 8
        assert bag.notes[0].startswith(f"{packed}: {len(stamps)} messages salvaged")


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_compressed_folders_need_no_metadata(mode: CompressionMode, plugin: StoragePlugin, tmp_path: Path) -> None:
    writer = OtherWriter(tmp_path / "a", version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/bodies", BODIES, typestore=typestore())
        for k in range(3):
            writer.write(connection, 1000 * k, message(k))
    assert read(tmp_path / "a") == (wanted(0, 1, 2), [])
    (tmp_path / "a" / "metadata.yaml").unlink()
    assert read(tmp_path / "a") == (wanted(0, 1, 2), [])


@pytest.mark.parametrize(
    ("head", "sentence"),
    [
        (b"PK\x03\x04" + bytes(20), "is a zip archive, which is not a readable ROS 2 bag: unpack it"),
        (bytes(257) + b"ustar" + bytes(300), "is a tar archive, .*: unpack it"),
        (b"#ROSBAG V1.2\n", "is a bag of the old format 1: `rosbag fix`"),
        (gzip.compress(b"hello", mtime=0), "is not a readable ROS 2 bag"),
    ],
)
def test_other_files_are_named_for_what_they_are(head: bytes, sentence: str, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(head)
    with pytest.raises(InputError, match=sentence):
        open_bag(tmp_path / "a.mcap")


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE])
def test_whole_messages_of_a_chunk_that_is_cut_are_read(compression: CompressionType, tmp_path: Path) -> None:
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=1 << 22, compression=compression)
    writer.start(profile="ros2", library="other")
    text = typestore().generate_msgdef(CLOUD, ros_version=2)[0].encode()
    channel = writer.register_channel("/points", "cdr", writer.register_schema(CLOUD, "ros2msg", text), {})
    messages = []
    for k in range(8):
        points = np.random.default_rng(k).normal(size=(30_000, 3))
        cloud = make_cloud(FACTORY, make_header(FACTORY, k, "lidar"), points)
        messages.append(bytes(typestore().serialize_cdr(cloud, CLOUD)))
        writer.add_message(channel, 1000 * k, messages[-1], 1000 * k, k)
    writer.finish()
    whole = stream.getvalue()
    assert whole.count(b"\x04\x00\x00\x00zstd") <= 2, "one chunk, and its index"
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[: len(whole) * 7 // 10])
    with open_bag(path, salvage=True) as bag:
        found = [(record.log_time, record.raw) for record in bag.messages()]
        (note,) = bag.notes
    # 7 / 10 of the file are 5.6 of the messages; zstd and lz4 give them in blocks.
    assert len(found) >= 4 and found == [(1000 * k, messages[k]) for k in range(len(found))]
    assert f"{len(found)} messages salvaged, {len(found)} of them from a chunk that is cut off" in note
    assert "damaged" not in note
