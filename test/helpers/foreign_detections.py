# SPDX-License-Identifier: Apache-2.0
"""Detections of other packages: their messages, defined here as those packages define them, and bags of them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from flowing_puppet_ros.bag.typestore import BagMessageFactory, typestore
from flowing_puppet_ros.stream.messages.geometry import make_header

YOLO, ZED = "yolo_msgs/msg/DetectionArray", "zed_msgs/msg/ObjectsStamped"
IDS, SKELETON = "hri_msgs/msg/IdsList", "hri_msgs/msg/Skeleton2D"
BOXES = "other_msgs/msg/DetectionArray"
DEFINITIONS = {
    "yolo_msgs/msg/Point2D": "float64 x\nfloat64 y",
    "yolo_msgs/msg/Vector2": "float64 x\nfloat64 y",
    "yolo_msgs/msg/Pose2D": "yolo_msgs/Point2D position\nfloat64 theta",
    "yolo_msgs/msg/BoundingBox2D": "yolo_msgs/Pose2D center\nyolo_msgs/Vector2 size",
    "yolo_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\nstring frame_id",
    "yolo_msgs/msg/Mask": "int32 height\nint32 width\nyolo_msgs/Point2D[] data",
    "yolo_msgs/msg/KeyPoint2D": "int32 id\nyolo_msgs/Point2D point\nfloat64 score",
    "yolo_msgs/msg/KeyPoint2DArray": "yolo_msgs/KeyPoint2D[] data",
    "yolo_msgs/msg/KeyPoint3D": "int32 id\ngeometry_msgs/Point point\nfloat64 score",
    "yolo_msgs/msg/KeyPoint3DArray": "yolo_msgs/KeyPoint3D[] data\nstring frame_id",
    "yolo_msgs/msg/Detection": "int32 class_id\nstring class_name\nfloat64 score\nstring id\n"
    "yolo_msgs/BoundingBox2D bbox\nyolo_msgs/BoundingBox3D bbox3d\nyolo_msgs/Mask mask\n"
    "yolo_msgs/KeyPoint2DArray keypoints\nyolo_msgs/KeyPoint3DArray keypoints3d",
    YOLO: "std_msgs/Header header\nyolo_msgs/Detection[] detections",
    "zed_msgs/msg/Keypoint2Di": "uint32[2] kp",
    "zed_msgs/msg/Keypoint2Df": "float32[2] kp",
    "zed_msgs/msg/Keypoint3D": "float32[3] kp",
    "zed_msgs/msg/BoundingBox2Di": "zed_msgs/Keypoint2Di[4] corners",
    "zed_msgs/msg/BoundingBox2Df": "zed_msgs/Keypoint2Df[4] corners",
    "zed_msgs/msg/BoundingBox3D": "zed_msgs/Keypoint3D[8] corners",
    "zed_msgs/msg/Skeleton2D": "zed_msgs/Keypoint2Df[70] keypoints",
    "zed_msgs/msg/Skeleton3D": "zed_msgs/Keypoint3D[70] keypoints",
    "zed_msgs/msg/Object": "string label\nint16 label_id\nstring sublabel\nfloat32 confidence\nfloat32[3] position\n"
    "float32[6] position_covariance\nfloat32[3] velocity\nbool tracking_available\nint8 tracking_state\n"
    "int8 action_state\nzed_msgs/BoundingBox2Di bounding_box_2d\nzed_msgs/BoundingBox3D bounding_box_3d\n"
    "float32[3] dimensions_3d\nbool skeleton_available\nint8 body_format\n"
    "zed_msgs/BoundingBox2Df head_bounding_box_2d\nzed_msgs/BoundingBox3D head_bounding_box_3d\n"
    "float32[3] head_position\nzed_msgs/Skeleton2D skeleton_2d\n"
    "zed_msgs/Skeleton3D skeleton_3d",
    ZED: "std_msgs/Header header\nzed_msgs/Object[] objects",
    "other_msgs/msg/Box": "float64 left\nfloat64 top",
    BOXES: "std_msgs/Header header\nother_msgs/Box[] detections",
}
SHAPES = {  # numbers of joints as the SDK's documentation lists them
    0: {
        **{"nose": 0, "right_shoulder": 2, "right_elbow": 3, "right_wrist": 4, "left_shoulder": 5, "left_elbow": 6},
        **{"left_wrist": 7, "right_hip": 8, "right_knee": 9, "right_ankle": 10, "left_hip": 11, "left_knee": 12},
        **{"left_ankle": 13, "right_eye": 14, "left_eye": 15, "right_ear": 16, "left_ear": 17},
    },
    1: {
        **{"left_shoulder": 5, "left_elbow": 6, "left_wrist": 7, "right_shoulder": 12, "right_elbow": 13},
        **{"right_wrist": 14, "left_hip": 18, "left_knee": 19, "left_ankle": 20, "right_hip": 22, "right_knee": 23},
        **{"right_ankle": 24, "nose": 27, "left_eye": 28, "left_ear": 29, "right_eye": 30, "right_ear": 31},
    },
    2: {
        **{"nose": 5, "left_eye": 6, "right_eye": 7, "left_ear": 8, "right_ear": 9, "left_shoulder": 12},
        **{"right_shoulder": 13, "left_elbow": 14, "right_elbow": 15, "left_wrist": 16, "right_wrist": 17},
        **{"left_hip": 18, "right_hip": 19, "left_knee": 20, "right_knee": 21, "left_ankle": 22, "right_ankle": 23},
    },
}
"""By `body_format` of the ZED SDK: joint -> number."""
COCO = (
    *("nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder", "left_elbow"),
    *("right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle"),
    "right_ankle",
)
HRI = {**SHAPES[0], "left_eye": 14, "right_eye": 15, "left_ear": 16, "right_ear": 17}
type Joints = Mapping[str, tuple[float, float, float]]
"""Joint -> x, y in pixels, confidence."""


class ForeignFactory(BagMessageFactory):
    """Makes messages of this package and of the others."""

    def __init__(self) -> None:
        """Register the others' definitions in a store of its own."""
        store = get_typestore(Stores.ROS2_JAZZY)
        store.register(typestore().fielddefs)
        for name, text in DEFINITIONS.items():
            store.register(get_types_from_msg(text, name))
        super().__init__(store)
        self.store = store


FACTORY = ForeignFactory()


def make_yolo(stamp: int, people: Sequence[Joints], ids: Sequence[str] = (), name: str = "person") -> Any:
    """Return the DetectionArray of a pose network; joints that are not given are missing."""
    make, made = FACTORY.make, []
    for number, joints in enumerate(people):
        points = [
            make("yolo_msgs/msg/KeyPoint2D", id=COCO.index(joint) + 1, score=c,
                 point=make("yolo_msgs/msg/Point2D", x=x, y=y))
            for joint, (x, y, c) in joints.items()
        ]  # fmt: skip
        keypoints = make("yolo_msgs/msg/KeyPoint2DArray", data=points)
        identity = ids[number] if ids else ""
        made.append(make("yolo_msgs/msg/Detection", class_name=name, score=0.9, id=identity, keypoints=keypoints))
    return make(YOLO, header=make_header(FACTORY, stamp, "camera"), detections=made)


def make_zed(stamp: int, people: Sequence[Joints], body_format: int = 2, ids: Sequence[int] = ()) -> Any:
    """Return the ObjectsStamped of body tracking; joints that are not given are at (0, 0)."""
    make, made = FACTORY.make, []
    for number, joints in enumerate(people):
        points = np.zeros((70, 2), np.float32)
        for joint, (x, y, _) in joints.items():
            points[SHAPES[body_format][joint]] = x, y
        skeleton = make("zed_msgs/msg/Skeleton2D", keypoints=[make("zed_msgs/msg/Keypoint2Df", kp=p) for p in points])
        made.append(
            make("zed_msgs/msg/Object", label=f"Body_{number}", label_id=ids[number] if ids else -1,
                 confidence=100 * max(c for _, _, c in joints.values()), tracking_available=bool(ids),
                 skeleton_available=True, body_format=body_format, skeleton_2d=skeleton)
        )  # fmt: skip
    return make(ZED, header=make_header(FACTORY, stamp, "camera"), objects=made)


def make_skeleton(stamp: int, joints: Joints, size: tuple[int, int], factory: Any = FACTORY) -> Any:
    """Return the Skeleton2D of REP-155 in an image of `size` (width, height)."""
    kind = "hri_msgs/msg/NormalizedPointOfInterest2D"
    points = [factory.make(kind, x=0.0, y=0.0, c=0.0) for _ in range(18)]
    for joint, (x, y, c) in joints.items():
        points[HRI[joint]] = factory.make(kind, x=(x + 0.5) / size[0], y=(y + 0.5) / size[1], c=c)
    return factory.make(SKELETON, header=make_header(factory, stamp, "camera"), skeleton=points)


def make_ids(stamp: int, ids: Sequence[str], factory: Any = FACTORY) -> Any:
    """Return the list of bodies of REP-155."""
    return factory.make(IDS, header=make_header(factory, stamp, "camera"), ids=list(ids))


def write_bag(path: Path, topics: Mapping[str, str], messages: Sequence[tuple[str, int, Any]]) -> Path:
    """Write an MCAP file of topics (name -> type) and messages (topic, log time, message or bytes)."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="other")
        channels = {}
        for topic, kind in topics.items():
            text, _ = FACTORY.store.generate_msgdef(kind, ros_version=2)
            channels[topic] = writer.register_channel(
                topic, "cdr", writer.register_schema(kind, "ros2msg", text.encode()), {}
            )
        for topic, log_time, message in messages:
            data = message if isinstance(message, bytes) else FACTORY.store.serialize_cdr(message, topics[topic])
            writer.add_message(channels[topic], log_time, bytes(data), log_time)
        writer.finish()
    return path
