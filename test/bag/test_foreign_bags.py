# SPDX-License-Identifier: Apache-2.0
"""Bags that other programs wrote, left unfinished or damaged: all that is there is read, in order, in little memory."""

from __future__ import annotations

import io
import tracemalloc
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as OtherWriter
from ruamel.yaml import YAML

from flowing_puppet_ros.bag.reader import Record, open_bag
from flowing_puppet_ros.bag.replay.replay import ReplayOptions, replay
from flowing_puppet_ros.bag.typestore import BagMessageFactory, typestore
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header

FACTORY = BagMessageFactory()
BODIES, CLOUD = "flowing_puppet_msgs/msg/BodyArray", "sensor_msgs/msg/PointCloud2"
TEXT = typestore().generate_msgdef(BODIES, ros_version=2)[0].encode()
COUNT = 40
IN_ORDER = list(range(COUNT))
SHUFFLED = [*range(COUNT // 2, COUNT), *range(COUNT // 2)]


def message(k: int) -> bytes:
    bodies = FACTORY.make(BODIES, header=make_header(FACTORY, k, f"frame_{k}"))
    return bytes(typestore().serialize_cdr(bodies, BODIES))


def written(order: list[int], profile: str = "ros2", encoding: str = "ros2msg", **options: Any) -> bytes:
    """An MCAP file by another writer, with an attachment, metadata and a channel that is no CDR between."""
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=600, **options)
    writer.start(profile=profile, library="other")
    writer.add_metadata("weather", {"sky": "grey"})
    writer.add_attachment(1, 2, "photo", "image/png", bytes(500))
    channel = writer.register_channel("/bodies", "cdr", writer.register_schema(BODIES, encoding, TEXT), {})
    notes = writer.register_channel("/notes", "json", 0, {})
    for k in order:
        writer.add_message(channel, 1000 * k, message(k), 1000 * k, k)
        writer.add_message(notes, 1000 * k, b"{}", 1000 * k, k)
    writer.finish()
    return stream.getvalue()


BARE: dict[str, Any] = {
    "index_types": IndexType.NONE,
    "use_statistics": False,
    "repeat_channels": False,
    "repeat_schemas": False,
    "use_summary_offsets": False,
}
KINDS: dict[str, dict[str, Any]] = {
    "uncompressed": {"compression": CompressionType.NONE},
    "lz4": {"compression": CompressionType.LZ4},
    "zstd": {"compression": CompressionType.ZSTD, "enable_data_crcs": True},
    "without chunks": {"use_chunking": False},
    "without message indexes": {"index_types": IndexType.CHUNK},
    "without statistics": {"use_statistics": False},
    "without checksums": {"enable_crcs": False},
    "without any index": BARE,
    "without chunks or index": {"use_chunking": False, **BARE},
    "of no profile": {"profile": ""},
    "of idl": {"encoding": "ros2idl"},
}


WHOLE = {"chunks": written(IN_ORDER), "no chunks": written(IN_ORDER, use_chunking=False)}
ORIGINALS = {(1000 * k, message(k)) for k in IN_ORDER}


def read(path: Path, **options: Any) -> list[tuple[int, bytes]]:
    with open_bag(path, **options) as bag:
        records = [record for record in bag.messages() if record.topic == "/bodies"]
        assert bag.details["/bodies"].count == len(records)
    return [(record.log_time, record.raw) for record in records]


@pytest.mark.parametrize("order", [IN_ORDER, SHUFFLED], ids=["in order", "shuffled"])
@pytest.mark.parametrize("kind", KINDS)
def test_files_of_other_writers_are_read_in_log_order(kind: str, order: list[int], tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(written(order, **KINDS[kind]))
    wanted = [(1000 * k, message(k)) for k in IN_ORDER]
    assert read(tmp_path / "a.mcap") == wanted
    assert read(tmp_path / "a.mcap", salvage=True) == wanted


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_compressed_folders_are_read(mode: CompressionMode, tmp_path: Path) -> None:
    writer = OtherWriter(tmp_path / "a", version=9, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/bodies", BODIES, typestore=typestore())
        for k in IN_ORDER:
            writer.write(connection, 1000 * k, message(k))
    wanted = [(1000 * k, message(k)) for k in IN_ORDER]
    assert read(tmp_path / "a") == wanted
    assert read(tmp_path / "a", salvage=True) == wanted


def split(folder: Path, metadata: bool = True) -> Path:
    """A rosbag2 folder of eleven files, the second of which sorts after the tenth by its letters."""
    folder.mkdir()
    names = []
    for part in range(11):
        with BagWriter(folder / f"a_{part}.mcap") as writer:
            writer.add_topic("/bodies", BODIES)
            for k in range(4 * part, min(4 * part + 4, COUNT)):
                writer.write_raw("/bodies", 1000 * k, message(k))
        names.append(f"a_{part}.mcap")
    if metadata:
        topic = {"name": "/bodies", "type": BODIES, "serialization_format": "cdr", "offered_qos_profiles": ""}
        about = {
            "version": 5,
            "storage_identifier": "mcap",
            "relative_file_paths": names,
            "duration": {"nanoseconds": 1000 * COUNT},
            "starting_time": {"nanoseconds_since_epoch": 0},
            "message_count": COUNT,
            "topics_with_message_count": [{"topic_metadata": topic, "message_count": COUNT}],
            "compression_format": "",
            "compression_mode": "",
        }
        YAML().dump({"rosbag2_bagfile_information": about}, folder / "metadata.yaml")
    return folder


@pytest.mark.parametrize("metadata", [True, False])
def test_split_bags_are_one(metadata: bool, tmp_path: Path) -> None:
    folder, wanted = split(tmp_path / "a", metadata), [(1000 * k, message(k)) for k in IN_ORDER]
    assert read(folder) == read(folder, salvage=True) == wanted
    last = folder / "a_9.mcap"
    last.write_bytes(last.read_bytes()[:-60])
    with pytest.raises(InputError, match=r"a_9.mcap is cut off before its end: add --salvage"):
        open_bag(folder)
    assert read(folder, salvage=True) == wanted, "only the index at the end is lost"


def test_a_file_cut_off_is_read_up_to_its_last_whole_chunk_and_says_so(tmp_path: Path) -> None:
    for name, share in (("chunks", 0.35), ("no chunks", 0.6)):
        (tmp_path / "cut.mcap").write_bytes(WHOLE[name][: int(share * len(WHOLE[name]))])
        found = read(tmp_path / "cut.mcap", salvage=True)
        assert 5 < len(found) < COUNT, name
        assert found == [(1000 * k, message(k)) for k in range(len(found))]
        with open_bag(tmp_path / "cut.mcap", salvage=True) as bag:
            (note,) = bag.notes
        assert f"cut.mcap: {len(found)} messages salvaged" in note


def test_damage_in_the_middle_costs_its_chunk_only(tmp_path: Path) -> None:
    whole = WHOLE["chunks"]
    mark = whole.index(b"\x04\x00\x00\x00zstd", len(whole) // 5)
    # In the data of a chunk, and over its head, which a reader with an index does not need.
    for place, length, seen in ((mark + 40, 4, True), (mark - 37, 9, False)):
        damaged = bytearray(whole)
        damaged[place : place + length] = bytes(length)
        (tmp_path / "bad.mcap").write_bytes(damaged)
        with pytest.raises(InputError, match=r"is damaged: .*add --salvage") if seen else nullcontext():
            read(tmp_path / "bad.mcap")
        found = read(tmp_path / "bad.mcap", salvage=True)
        assert COUNT - 12 <= len(found) < COUNT
        assert {time for time, _ in found} >= {0, 1000 * (COUNT - 1)}
        with open_bag(tmp_path / "bad.mcap", salvage=True) as bag:
            assert "damaged" in bag.notes[0]


def test_replays_tell_what_was_salvaged(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "in.mcap") as writer:
        writer.add_topic("/points", CLOUD)
        empty = make_cloud(FACTORY, make_header(FACTORY, 1, "lidar"), np.zeros((0, 3)))
        writer.write("/points", 0, empty)
    whole = (tmp_path / "in.mcap").read_bytes()
    (tmp_path / "in.mcap").write_bytes(whole[:-30])
    options = ReplayOptions(salvage=True, progress=False)
    summary = replay(tmp_path / "in.mcap", tmp_path / "out.mcap", options)
    assert summary["warnings"][0].endswith("in.mcap: 1 messages salvaged")


@pytest.mark.parametrize("salvage", [False, True])
def test_memory_stays_small_on_large_files(salvage: bool, tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap") as writer:
        writer.add_topic("/points", CLOUD)
        for k in range(40):
            points = np.random.default_rng(k).normal(size=(40_000, 3))
            cloud = make_cloud(FACTORY, make_header(FACTORY, k, "lidar"), points)
            writer.write("/points", k, cloud)
    assert (tmp_path / "a.mcap").stat().st_size > 15_000_000
    tracemalloc.start()
    with open_bag(tmp_path / "a.mcap", salvage) as bag:
        assert sum(1 for _ in bag.messages()) == 40
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 12_000_000


@settings(max_examples=60, deadline=None)
@given(kind=st.sampled_from(sorted(WHOLE)), data=st.data())
def test_no_damage_is_more_than_a_sentence(kind: str, data: Any, tmp_path_factory: pytest.TempPathFactory) -> None:
    whole = bytearray(WHOLE[kind])
    for _ in range(data.draw(st.integers(0, 4), "changes")):
        place = data.draw(st.integers(8, len(whole) - 1), "place")
        piece = data.draw(st.binary(min_size=1, max_size=12), "piece")
        whole[place : place + len(piece)] = piece
    path = tmp_path_factory.mktemp("damage") / "a.mcap"
    path.write_bytes(whole[: data.draw(st.integers(8, len(whole)), "length")])
    for salvage in (False, True):
        try:
            with open_bag(path, salvage) as bag:
                found = [(record.log_time, record.raw) for record in bag.messages()]
                unverified = any("from a chunk that is cut off" in note for note in bag.notes)
        except InputError as error:
            assert "\n" not in str(error)
            continue
        if salvage and kind == "chunks" and not unverified:
            assert set(found) <= ORIGINALS, "what a checksum vouches for is unchanged"


@settings(max_examples=150, deadline=None)
@given(
    kind=st.sampled_from(
        [
            BODIES,
            CLOUD,
            "sensor_msgs/msg/Image",
            "flowing_puppet_msgs/msg/PuppetArray",
            "flowing_puppet_msgs/msg/SilhouetteSet",
            "tf2_msgs/msg/TFMessage",
            "hri_msgs/msg/Skeleton2D",
            "unknown_msgs/msg/Thing",
        ]
    ),
    raw=st.binary(max_size=300) | st.binary(max_size=80).map(lambda tail: b"\x00\x01\x00\x00" + tail),
)
def test_any_bytes_are_a_message_or_a_sentence(kind: str, raw: bytes) -> None:
    try:
        Record("/topic", kind, 0, raw).message  # noqa: B018
    except InputError as error:
        assert "/topic" in str(error)
