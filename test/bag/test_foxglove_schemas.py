# SPDX-License-Identifier: Apache-2.0
"""Recordings with Foxglove's schemas, in JSON, protobuf and CDR, are read as the ROS 2 messages that they mean."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, json_format
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from flowing_puppet_ros.bag.foreign.foxglove import find_schema
from flowing_puppet_ros.bag.foreign.payloads import make_protobuf_class
from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.clouds import decode_cloud
from flowing_puppet_ros.stream.messages.images import decode_image
from flowing_puppet_ros.stream.messages.message_types import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    POINT_CLOUD,
    TRANSFORMS,
)

PIXELS = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
POINTS = np.array([[1.0, 2, 3], [-4, 5, 6]], np.float32)
K = [500.0, 0, 2, 0, 501, 1, 0, 0, 1]
QUARTER = {"x": 0.0, "y": 0.0, "z": float(np.sqrt(0.5)), "w": float(np.sqrt(0.5))}
"""A quarter turn about z: x becomes y."""


def text(data: Any) -> str:
    return base64.b64encode(bytes(data)).decode()


def fields() -> list[dict[str, Any]]:
    return [{"name": name, "offset": 4 * place, "type": 7} for place, name in enumerate("xyz")]


STAMP = {"timestamp": {"sec": 1_500_000_000, "nsec": 5}, "frame_id": "eye"}
TRANSFORM = {
    "timestamp": STAMP["timestamp"],
    "parent_frame_id": "room",
    "child_frame_id": "eye",
    "translation": {"x": 1.0, "y": 2.0, "z": 3.0},
    "rotation": QUARTER,
}
MESSAGES: dict[str, dict[str, Any]] = {
    "RawImage": STAMP | {"width": 4, "height": 2, "encoding": "rgb8", "step": 12, "data": text(PIXELS)},
    "CompressedImage": STAMP | {"format": "jpeg", "data": text(range(20))},
    "CompressedVideo": STAMP | {"format": "h264", "data": text(range(20))},
    "PointCloud": STAMP | {
        "pose": {"position": {"x": 10.0, "y": 0.0, "z": 0.5}, "orientation": QUARTER},
        "point_stride": 12, "fields": fields(), "data": text(POINTS),
    },
    "CameraCalibration": STAMP | {
        "width": 4, "height": 2, "distortion_model": "plumb_bob", "D": [0.0] * 5, "K": K, "R": [], "P": [1.5] * 12,
    },
    "FrameTransform": TRANSFORM,
    "FrameTransforms": {"transforms": [TRANSFORM]},
}  # fmt: skip
TYPES = {
    "RawImage": IMAGE, "CompressedImage": COMPRESSED_IMAGE, "CompressedVideo": COMPRESSED_IMAGE,
    "PointCloud": POINT_CLOUD, "CameraCalibration": CAMERA_INFO, "FrameTransform": TRANSFORMS,
    "FrameTransforms": TRANSFORMS,
}  # fmt: skip


def check(kind: str, message: Any) -> None:
    """Check a message against what was written."""
    head = message.transforms[0].header if TYPES[kind] == TRANSFORMS else message.header
    assert (head.stamp.sec, head.stamp.nanosec) == (1_500_000_000, 5)
    assert head.frame_id == ("room" if TYPES[kind] == TRANSFORMS else "eye")
    if kind == "RawImage":
        np.testing.assert_array_equal(decode_image(message), PIXELS)
    elif kind == "PointCloud":
        # (x, y, z) turned a quarter is (-y, x, z).
        np.testing.assert_allclose(decode_cloud(message)[0], [[8, 1, 3.5], [5, -4, 6.5]], atol=1e-6)
    elif kind == "CameraCalibration":
        assert (message.width, message.height, message.distortion_model) == (4, 2, "plumb_bob")
        np.testing.assert_array_equal(message.k, K)
        np.testing.assert_array_equal(message.p, [1.5] * 12)
        assert (len(message.d), len(message.r)) == (5, 9)
    elif TYPES[kind] == TRANSFORMS:
        moved = message.transforms[0]
        shift, turn = moved.transform.translation, moved.transform.rotation
        assert (moved.child_frame_id, shift.x, shift.y, shift.z) == ("eye", 1.0, 2.0, 3.0)
        np.testing.assert_allclose([turn.x, turn.y, turn.z, turn.w], list(QUARTER.values()))
    else:
        assert message.format == MESSAGES[kind]["format"]
        np.testing.assert_array_equal(message.data, np.arange(20))


def recorded(path: Path, name: str, encoding: str, schema: tuple[str, bytes], data: bytes) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="", library="other")
        number = writer.register_schema(name, schema[0], schema[1])
        channel = writer.register_channel("/topic", encoding, number, {})
        writer.add_message(channel, 7, data, 7, 0)
        writer.finish()
    return path


def read(path: Path, kind: str) -> Any:
    with open_bag(path) as bag:
        assert bag.topics == {"/topic": TYPES[kind]}
        (record,) = bag.messages()
        return record.message


@pytest.mark.parametrize("kind", MESSAGES)
def test_json(kind: str, tmp_path: Path) -> None:
    data = json.dumps(MESSAGES[kind]).encode()
    path = recorded(tmp_path / "a.mcap", f"foxglove.{kind}", "json", ("jsonschema", b"{}"), data)
    check(kind, read(path, kind))


# The numbers of the fields do not matter here: what is read comes from the definition in the file.
SCALARS = {"string": 9, "bytes": 12, "uint32": 13, "double": 1, "fixed32": 7, "int64": 3, "int32": 5}
PROTO: dict[str, dict[str, str]] = {
    "Timestamp": {"seconds": "int64", "nanos": "int32"},
    "Vector3": {"x": "double", "y": "double", "z": "double"},
    "Quaternion": {"x": "double", "y": "double", "z": "double", "w": "double"},
    "Pose": {"position": "Vector3", "orientation": "Quaternion"},
    "PackedElementField": {"name": "string", "offset": "fixed32", "type": "int32"},
    "RawImage": {
        "timestamp": "Timestamp", "frame_id": "string", "width": "fixed32", "height": "fixed32", "encoding": "string",
        "step": "fixed32", "data": "bytes",
    },
    "CompressedImage": {"timestamp": "Timestamp", "frame_id": "string", "data": "bytes", "format": "string"},
    "CompressedVideo": {"timestamp": "Timestamp", "frame_id": "string", "data": "bytes", "format": "string"},
    "PointCloud": {
        "timestamp": "Timestamp", "frame_id": "string", "pose": "Pose", "point_stride": "fixed32",
        "fields": "PackedElementField*", "data": "bytes",
    },
    "CameraCalibration": {
        "timestamp": "Timestamp", "frame_id": "string", "width": "fixed32", "height": "fixed32",
        "distortion_model": "string", "D": "double*", "K": "double*", "R": "double*", "P": "double*",
    },
    "FrameTransform": {
        "timestamp": "Timestamp", "parent_frame_id": "string", "child_frame_id": "string", "translation": "Vector3",
        "rotation": "Quaternion",
    },
    "FrameTransforms": {"transforms": "FrameTransform*"},
}  # fmt: skip


def definitions() -> descriptor_pb2.FileDescriptorSet:
    """Return the definitions as one file per message, those that are imported last."""
    found = descriptor_pb2.FileDescriptorSet()
    for name, parts in reversed(PROTO.items()):
        file = found.file.add(name=f"foxglove/{name}.proto", package="foxglove", syntax="proto3")
        kind = file.message_type.add(name=name)
        for number, (field, what) in enumerate(parts.items(), start=1):
            base = what.rstrip("*")
            item = kind.field.add(name=field, number=number, label=3 if what.endswith("*") else 1, json_name=field)
            item.type = SCALARS.get(base, 11)  # type: ignore[assignment]
            if base not in SCALARS:
                item.type_name = f".foxglove.{base}"
                if (imported := f"foxglove/{base}.proto") not in file.dependency:
                    file.dependency.append(imported)
    return found


@pytest.mark.parametrize("kind", MESSAGES)
def test_protobuf(kind: str, tmp_path: Path) -> None:
    pool, files = descriptor_pool.DescriptorPool(), definitions()
    for file in reversed(files.file):
        pool.Add(file)  # type: ignore[no-untyped-call]
    words = json.dumps(MESSAGES[kind]).replace('"sec"', '"seconds"').replace('"nsec"', '"nanos"')
    message = make_protobuf_class(pool.FindMessageTypeByName(f"foxglove.{kind}"))()
    data = json_format.Parse(words, message, descriptor_pool=pool).SerializeToString()
    schema = ("protobuf", files.SerializeToString())
    check(kind, read(recorded(tmp_path / "a.mcap", f"foxglove.{kind}", "protobuf", schema, data), kind))


def test_cdr_by_the_definition_in_the_file(tmp_path: Path) -> None:
    definition = """builtin_interfaces/Time timestamp
string frame_id
uint8[] data
string format
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
    name = "foxglove_msgs/msg/CompressedVideo"
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition, name))
    types: Any = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=1_500_000_000, nanosec=5)
    message = types[name](stamp, "eye", np.arange(20, dtype=np.uint8), "h264")
    data = bytes(store.serialize_cdr(message, name))
    path = recorded(tmp_path / "a.mcap", name, "cdr", ("ros2msg", definition.encode()), data)
    check("CompressedVideo", read(path, "CompressedVideo"))


def test_fields_that_json_leaves_out_have_their_defaults(tmp_path: Path) -> None:
    left = {"width": 1, "height": 1, "encoding": "mono8", "step": 1, "data": text([9])}
    path = recorded(tmp_path / "a.mcap", "foxglove.RawImage", "json", ("", b""), json.dumps(left).encode())
    message = read(path, "RawImage")
    assert (message.header.stamp.sec, message.header.frame_id) == (0, "")
    assert decode_image(message).tolist() == [[[9, 9, 9]]]


def test_clouds_without_a_pose_keep_all_fields(tmp_path: Path) -> None:
    unmoved = {name: value for name, value in MESSAGES["PointCloud"].items() if name != "pose"}
    unmoved["fields"] = [*fields(), {"name": "intensity", "offset": 10, "type": 3}]
    path = recorded(tmp_path / "a.mcap", "foxglove.PointCloud", "json", ("", b""), json.dumps(unmoved).encode())
    message = read(path, "PointCloud")
    np.testing.assert_array_equal(decode_cloud(message)[0], POINTS)
    # 3 is UINT16 in Foxglove's numbering; in ROS 3 is INT16 and 4 is UINT16.
    assert [(field.name, field.datatype) for field in message.fields][-1] == ("intensity", 4)


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
@pytest.mark.parametrize("data", [b"", b"{}", b"{", b"\xff\xff\xff", b'{"data": 3, "width": "wide"}'])
def test_wrong_messages_are_one_sentence(encoding: str, data: bytes, tmp_path: Path) -> None:
    schema = ("protobuf", b"\x99") if encoding == "protobuf" else ("jsonschema", b"{}")
    path = recorded(tmp_path / "a.mcap", "foxglove.RawImage", encoding, schema, data)
    with open_bag(path) as bag:
        (record,) = bag.messages()
        with pytest.raises(InputError, match="a message on /topic is not the sensor_msgs/msg/Image"):
            _ = record.message


def test_names_of_schemas() -> None:
    for name in ("foxglove.RawImage", "foxglove_msgs/RawImage", "foxglove_msgs/msg/RawImage", "foxglove::RawImage"):
        found = find_schema(name)
        assert found is not None and found.type == IMAGE
    assert find_schema("foxglove.Log") is None
    assert find_schema("other.RawImage") is None
