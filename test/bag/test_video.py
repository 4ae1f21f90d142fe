# SPDX-License-Identifier: Apache-2.0
"""Video in CompressedImage and CompressedVideo is decoded in its order, and said to be video where it cannot be."""

from __future__ import annotations

import base64
import io
import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from flowing_puppet_ros.bag.foreign import video
from flowing_puppet_ros.bag.frames import open_bag_frames
from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.geometry import make_header, stamp_ns
from flowing_puppet_ros.stream.messages.images import decode_image, encode_jpeg
from flowing_puppet_ros.stream.messages.message_types import COMPRESSED_IMAGE
from test.helpers.definitions import HEADER

FACTORY = BagMessageFactory()
COUNT = 8
TENTH = 100_000_000


def picture(k: int) -> np.ndarray:
    """A smooth picture whose grey grows from image to image, with a bright square that moves."""
    pixels = np.full((64, 96, 3), 40 + 15 * k, np.uint8)
    pixels[16:48, 8 * k : 8 * k + 24] = (250, 120, 30)
    return pixels


def packets(codec: str, b_frames: int = 0) -> list[bytes]:
    """Return the packets of the pictures, in the order of decoding."""
    av = pytest.importorskip("av", reason="the extra `video`")
    try:
        context: Any = av.CodecContext.create(codec, "w")
        context.width, context.height, context.pix_fmt = 96, 64, "yuv420p"
        context.time_base = Fraction(1, 10)
        context.options = {"crf": "12", "g": "4", "bf": str(b_frames), "x265-params": "log-level=none"}
        context.open()
    except (av.error.FFmpegError, ValueError):
        pytest.skip(f"this FFmpeg has no {codec}")
    found = []
    for k in range(COUNT):
        frame = av.VideoFrame.from_ndarray(picture(k), format="rgb24")
        frame.pts = k
        found += [bytes(packet) for packet in context.encode(frame)]
    return found + [bytes(packet) for packet in context.encode(None)]


def recorded(path: Path, data: list[bytes], form: str, name: str = "/eye/image/compressed") -> Path:
    with BagWriter(path) as writer:
        writer.add_topic(name, COMPRESSED_IMAGE)
        for k, packet in enumerate(data):
            header = make_header(FACTORY, k * TENTH, "eye")
            message = FACTORY.make(COMPRESSED_IMAGE, header=header, format=form, data=np.frombuffer(packet, np.uint8))
            writer.write(name, 10**12 + k * TENTH, message)
    return path


def check(path: Path, first: int = 0) -> None:
    with open_bag(path) as bag:
        assert set(bag.topics.values()) == {COMPRESSED_IMAGE}
        records = list(bag.messages())
    assert [record.log_time for record in records] == sorted(record.log_time for record in records)
    assert [stamp_ns(record.message) for record in records] == [k * TENTH for k in range(first, COUNT)]
    for k, record in enumerate(records, start=first):
        assert record.message.header.frame_id == "eye"
        assert np.abs(decode_image(record.message).astype(int) - picture(k)).mean() < 4, k


@pytest.mark.parametrize(
    ("encoder", "form"), [("libx264", "h264"), ("libx265", "H.265"), ("libx265", "hevc"), ("libvpx-vp9", "vp9")]
)
def test_video_is_decoded(encoder: str, form: str, tmp_path: Path) -> None:
    path = recorded(tmp_path / "a.mcap", packets(encoder), form)
    check(path)
    check(path)
    frames = [frame.image for frame, _ in open_bag_frames(path)]
    assert len(frames) == COUNT and np.abs(frames[-1].astype(int) - picture(COUNT - 1)).mean() < 4


def test_images_that_wait_for_later_ones_come_at_the_end(tmp_path: Path) -> None:
    # The stamps of packets are those of decoding here, so only their number and order is known.
    path = recorded(tmp_path / "a.mcap", packets("libx264", b_frames=2), "h264")
    with open_bag(path) as bag:
        images = [decode_image(record.message) for record in bag.messages()]
    assert len(images) == COUNT
    greys = [int(np.median(image)) for image in images]
    assert greys == sorted(greys)


def test_splits_of_a_video_are_decoded_as_one(tmp_path: Path) -> None:
    data = packets("libx264")
    (tmp_path / "a").mkdir()
    whole = recorded(tmp_path / "whole.mcap", data, "h264")
    with open_bag(whole) as bag:
        bag_records = [(t, raw) for _, t, raw in bag._files[0].messages([0])]
    for part, chosen in enumerate((bag_records[:3], bag_records[3:])):
        with BagWriter(tmp_path / "a" / f"a_{part}.mcap") as writer:
            writer.add_topic("/eye/image/compressed", COMPRESSED_IMAGE)
            for log_time, raw in chosen:
                writer.write_raw("/eye/image/compressed", log_time, raw)
    check(tmp_path / "a")


def test_what_comes_before_the_first_key_frame_is_left_out_or_told_of(tmp_path: Path) -> None:
    path = recorded(tmp_path / "a.mcap", packets("libx264")[2:], "h264")
    with open_bag(path) as bag:
        records = list(bag.messages())
    good, told = [], 0
    for record in records:
        try:
            good.append(decode_image(record.message))
        except InputError as error:
            assert "is video, whose images need those before them" in str(error)
            told += 1
    # Key frames are 0 and 4.
    assert len(good) >= 4 and np.abs(good[-1].astype(int) - picture(COUNT - 1)).mean() < 4
    assert len(good) + told <= COUNT - 2


def test_without_pyav_it_is_said_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(codec: str) -> Any:
        raise ModuleNotFoundError("No module named 'av'")

    monkeypatch.setattr(video, "_Stream", absent)
    path = recorded(tmp_path / "a.mcap", [b"\0\0\0\1\x67"] * 2, "h264")
    with open_bag(path) as bag:
        for record in bag.messages():
            with pytest.raises(
                InputError, match=r"'h264' is video, .* is decoded .* if PyAV is there \(`pip install av`"
            ):
                decode_image(record.message)


def test_other_images_are_untouched_even_in_a_frame_named_like_a_codec(tmp_path: Path) -> None:
    message = FACTORY.make(
        COMPRESSED_IMAGE, header=make_header(FACTORY, 1, "h264_eye"), format="jpeg", data=encode_jpeg(picture(3))
    )
    with BagWriter(tmp_path / "a.mcap") as writer:
        writer.add_topic("/eye/image/compressed", COMPRESSED_IMAGE)
        writer.write("/eye/image/compressed", 0, message)
    with open_bag(tmp_path / "a.mcap") as bag:
        (record,) = bag.messages()
    np.testing.assert_array_equal(record.message.data, message.data)


def test_packets_of_other_schemas_are_decoded(tmp_path: Path) -> None:
    data = packets("libx264")
    name = "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
    text = (
        """std_msgs/Header header
int32 width
int32 height
string encoding
uint64 pts
uint8 flags
bool is_bigendian
uint8[] data
"""
        + HEADER
    )
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, name))
    types: Any = store.types
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start(profile="ros2", library="other")
    packet_schema = writer.register_schema(name, "ros2msg", text.encode())
    packet_channel = writer.register_channel("/eye/image_raw/ffmpeg", "cdr", packet_schema, {})
    video_schema = writer.register_schema("foxglove.CompressedVideo", "jsonschema", b"{}")
    video_channel = writer.register_channel("/eye/video", "json", video_schema, {})
    for k, packet in enumerate(data):
        stamp = types["builtin_interfaces/msg/Time"](sec=0, nanosec=k * TENTH)
        header = types["std_msgs/msg/Header"](stamp, "eye")
        array = np.frombuffer(packet, np.uint8)
        message = types[name](header, 96, 64, "h264;yuv420p;bgr8", k, 0, False, array)
        writer.add_message(packet_channel, k * TENTH, bytes(store.serialize_cdr(message, name)), k * TENTH, k)
        words = {"timestamp": {"sec": 0, "nsec": k * TENTH}, "frame_id": "eye", "format": "h264"}
        words["data"] = base64.b64encode(packet).decode()
        writer.add_message(video_channel, k * TENTH, json.dumps(words).encode(), k * TENTH, k)
    writer.finish()
    (tmp_path / "a.mcap").write_bytes(stream.getvalue())
    with open_bag(tmp_path / "a.mcap") as bag:
        for topic in ("/eye/image_raw/ffmpeg", "/eye/video"):
            images = [decode_image(record.message) for record in bag.messages([topic])]
            assert len(images) == COUNT
            for k, image in enumerate(images):
                assert np.abs(image.astype(int) - picture(k)).mean() < 4
