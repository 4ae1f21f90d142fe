# SPDX-License-Identifier: Apache-2.0
"""A subscriber of another DDS implementation: prints what it hears of rt/puppets and rt/bodies as one JSON object.

Runs in an environment of its own, in which Cyclone DDS is and ROS is not. The types are those that ROS makes of the
interface package: `<package>::msg::dds_::<Type>_`, plain CDR.
"""

# Annotations are read at run time here: they must not become strings.

import json
import sys
import time
from dataclasses import dataclass
from typing import Any

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float32, float64, int32, sequence, uint8, uint32
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

OWN = "flowing_puppet_msgs::msg::dds_::"


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    """Stamp."""

    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    """Stamp and frame."""

    stamp: Time
    frame_id: str


@dataclass
class PuppetJoint(IdlStruct, typename=OWN + "PuppetJoint_"):
    """Joint in an image."""

    name: str
    x: float32
    y: float32
    confidence: float32


@dataclass
class PuppetPart(IdlStruct, typename=OWN + "PuppetPart_"):
    """Part in an image."""

    name: str
    label: uint8
    depth: int32
    confidence: float32
    contour: sequence[float32]


@dataclass
class Puppet(IdlStruct, typename=OWN + "Puppet_"):
    """Person in an image."""

    id: str
    model: str
    view: str
    scale: float32
    energy: float32
    confidence: float32
    joints: sequence[PuppetJoint]
    parts: sequence[PuppetPart]


@dataclass
class PuppetArray(IdlStruct, typename=OWN + "PuppetArray_"):
    """People in an image."""

    header: Header
    puppets: sequence[Puppet]


@dataclass
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    """Position."""

    x: float64
    y: float64
    z: float64


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    """Vector."""

    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    """Rotation."""

    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Pose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    """Position and rotation."""

    position: Point
    orientation: Quaternion


@dataclass
class BodyJoint(IdlStruct, typename=OWN + "BodyJoint_"):
    """Joint in space."""

    name: str
    position: Point
    confidence: float32
    visibility: uint8


@dataclass
class BodyPart(IdlStruct, typename=OWN + "BodyPart_"):
    """Part in space."""

    name: str
    pose: Pose
    shape_coefficients: sequence[float32]
    pose_coefficients: sequence[float32]
    confidence: float32
    visibility: uint8


@dataclass
class Body(IdlStruct, typename=OWN + "Body_"):
    """Person in space."""

    id: str
    state: uint8
    model: str
    energy: float32
    confidence: float32
    reliable: bool
    height: float32
    velocity: Vector3
    joints: sequence[BodyJoint]
    parts: sequence[BodyPart]


@dataclass
class BodyArray(IdlStruct, typename=OWN + "BodyArray_"):
    """People in space."""

    header: Header
    bodies: sequence[Body]


def plain(value: Any) -> Any:
    """The value as what JSON holds."""
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__}
    return [plain(item) for item in value] if isinstance(value, list | tuple) else value


def main(domain: int, seconds: float) -> int:
    """Wait for one message on each topic and print them; 1 when they do not come in time."""
    participant = DomainParticipant(domain)
    qos = Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepLast(10))
    readers = {
        name: DataReader(participant, Topic(participant, f"rt/{name}", kind, qos=qos), qos=qos)
        for name, kind in (("puppets", PuppetArray), ("bodies", BodyArray))
    }
    print("ready", flush=True)
    heard: dict[str, Any] = {}
    until = time.monotonic() + seconds
    while len(heard) < len(readers) and time.monotonic() < until:
        for name, reader in readers.items():
            for message in reader.take(10):
                if hasattr(message, "header"):
                    heard.setdefault(name, plain(message))
        time.sleep(0.02)
    print(json.dumps(heard), flush=True)
    return 0 if len(heard) == len(readers) else 1


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), float(sys.argv[2])))
