# SPDX-License-Identifier: Apache-2.0
"""The schemas of Foxglove (docs.foxglove.dev, "Foxglove schemas"), and others' packets of video, to ROS 2 messages.

The objects that come in have the fields of a schema as attributes; in JSON any may be missing.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowing_puppet_ros.bag.foreign.payloads import read_bytes
from flowing_puppet_ros.stream.messages.clouds import decode_cloud, make_cloud
from flowing_puppet_ros.stream.messages.geometry import header_ns, make_header, rotation_matrix
from flowing_puppet_ros.stream.messages.message_types import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    POINT_CLOUD,
    TRANSFORMS,
    MessageFactory,
)
from flowing_puppet_ros.units import NANOSECONDS

_POINT_TYPES = {1: 2, 2: 1, 3: 4, 4: 3, 5: 6, 6: 5, 7: 7, 8: 8}
"""Number of a numeric type in Foxglove's schemas, where unsigned types come first -> in sensor_msgs/PointField."""


@dataclass(frozen=True, slots=True)
class ForeignSchema:
    """The ROS 2 type that a schema becomes, and how."""

    type: str
    build: Callable[[MessageFactory, Any], Any]


def find_schema(name: str) -> ForeignSchema | None:
    """Return what becomes of a schema, by its name in JSON, protobuf, ROS 1, ROS 2 or IDL; None for other types.

    The cloud of the first years of ROS, `sensor_msgs/PointCloud`, is one too.
    """
    if re.fullmatch(r"sensor_msgs/(?:msg/)?PointCloud", name):
        return ForeignSchema(POINT_CLOUD, _build_old_cloud)
    if re.fullmatch(r"ffmpeg_image_transport_msgs(?:/msg)?/FFMPEGPacket", name):
        return ForeignSchema(COMPRESSED_IMAGE, _build_packet)
    found = re.fullmatch(r"foxglove(?:_msgs)?(?:\.|/|::)(?:msg(?:\.|/|::))?(\w+)", name)
    return _SCHEMAS.get(found[1]) if found else None


def _build_image(factory: MessageFactory, image: Any) -> Any:
    return factory.make(
        IMAGE,
        header=_make_header(factory, image),
        height=image.height,
        width=image.width,
        encoding=image.encoding,
        is_bigendian=0,
        step=image.step,
        data=read_bytes(image.data),
    )


def _build_compressed(factory: MessageFactory, image: Any) -> Any:
    header = _make_header(factory, image)
    return factory.make(COMPRESSED_IMAGE, header=header, format=image.format, data=read_bytes(image.data))


def _build_packet(factory: MessageFactory, packet: Any) -> Any:
    header = _copy_header(factory, packet.header)
    form = packet.encoding.partition(";")[0]  # behind it the names of pixel formats
    return factory.make(COMPRESSED_IMAGE, header=header, format=form, data=read_bytes(packet.data))


def _build_cloud(factory: MessageFactory, cloud: Any) -> Any:
    header, data, stride = _make_header(factory, cloud), read_bytes(cloud.data), int(cloud.point_stride)
    fields = [
        factory.make(
            "sensor_msgs/msg/PointField",
            name=item.name,
            offset=getattr(item, "offset", 0),
            datatype=_POINT_TYPES.get(int(item.type), 0),
            count=1,
        )
        for item in cloud.fields
    ]
    count = len(data) // stride if stride else 0
    message = factory.make(
        POINT_CLOUD,
        header=header,
        height=1,
        width=count,
        fields=fields,
        is_bigendian=False,
        point_step=stride,
        row_step=count * stride,
        data=data[: count * stride],
        is_dense=False,
    )
    rotation, translation = _read_pose(getattr(cloud, "pose", None))
    if np.array_equal(rotation, np.eye(3)) and not translation.any():
        return message
    points, normals = decode_cloud(message)
    turned = None if normals is None else normals @ rotation.T
    return make_cloud(factory, header, points @ rotation.T + translation, turned)


def _build_old_cloud(factory: MessageFactory, cloud: Any) -> Any:
    header = _copy_header(factory, cloud.header)
    return make_cloud(factory, header, np.array([[point.x, point.y, point.z] for point in cloud.points]).reshape(-1, 3))


def _build_calibration(factory: MessageFactory, camera: Any) -> Any:
    def read(name: str, length: int) -> Any:
        values = getattr(camera, name, getattr(camera, name.lower(), ()))  # rosbags writes d for the D of ROS 1
        return np.asarray(list(values) or np.zeros(length), float)

    return factory.make(
        CAMERA_INFO,
        header=_make_header(factory, camera),
        height=camera.height,
        width=camera.width,
        distortion_model=getattr(camera, "distortion_model", ""),
        d=read("D", 0),
        k=read("K", 9),
        r=read("R", 9),
        p=read("P", 12),
    )


def _build_transform(factory: MessageFactory, transform: Any) -> Any:
    return factory.make(TRANSFORMS, transforms=[_make_transform(factory, transform)])


def _build_transforms(factory: MessageFactory, message: Any) -> Any:
    return factory.make(TRANSFORMS, transforms=[_make_transform(factory, item) for item in message.transforms])


def _make_transform(factory: MessageFactory, transform: Any) -> Any:
    values = _read_vector(getattr(transform, "translation", None), "xyz")
    turn = _read_vector(getattr(transform, "rotation", None), "xyzw")
    x, y, z, w = turn if any(turn) else (0.0, 0.0, 0.0, 1.0)
    return factory.make(
        "geometry_msgs/msg/TransformStamped",
        header=make_header(factory, _read_time(transform), transform.parent_frame_id),
        child_frame_id=transform.child_frame_id,
        transform=factory.make(
            "geometry_msgs/msg/Transform",
            translation=factory.make("geometry_msgs/msg/Vector3", x=values[0], y=values[1], z=values[2]),
            rotation=factory.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        ),
    )


def _make_header(factory: MessageFactory, message: Any) -> Any:
    return make_header(factory, _read_time(message), getattr(message, "frame_id", ""))


def _copy_header(factory: MessageFactory, header: Any) -> Any:
    """Return a header of another version of ROS as one of ROS 2."""
    return make_header(factory, header_ns(header), header.frame_id)


def _read_time(message: Any) -> int:
    """Return the stamp in nanoseconds; its parts are named differently in each encoding."""
    stamp = getattr(message, "timestamp", None)
    seconds = next((getattr(stamp, name) for name in ("sec", "seconds", "secs") if hasattr(stamp, name)), 0)
    rest = next((getattr(stamp, name) for name in ("nsec", "nanos", "nanosec", "nsecs") if hasattr(stamp, name)), 0)
    return int(seconds) * NANOSECONDS + int(rest)


def _read_pose(pose: Any) -> tuple[Any, Any]:
    """Return rotation (3, 3) and translation (3,) in metres of a pose, which may be missing."""
    turn = _read_vector(getattr(pose, "orientation", None), "xyzw")
    rotation = rotation_matrix(turn) if any(turn) else np.eye(3)
    return rotation, np.array(_read_vector(getattr(pose, "position", None), "xyz"))


def _read_vector(vector: Any, names: str) -> list[float]:
    return [float(getattr(vector, name, 0.0)) for name in names]


_SCHEMAS = {
    "RawImage": ForeignSchema(IMAGE, _build_image),
    "CompressedImage": ForeignSchema(COMPRESSED_IMAGE, _build_compressed),
    "CompressedVideo": ForeignSchema(COMPRESSED_IMAGE, _build_compressed),
    "PointCloud": ForeignSchema(POINT_CLOUD, _build_cloud),
    "CameraCalibration": ForeignSchema(CAMERA_INFO, _build_calibration),
    "FrameTransform": ForeignSchema(TRANSFORMS, _build_transform),
    "FrameTransforms": ForeignSchema(TRANSFORMS, _build_transforms),
}
