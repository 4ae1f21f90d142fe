# SPDX-License-Identifier: Apache-2.0
"""The types of the messages that come in and go out, and the factory of messages of any kind."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from flowing_puppet_ros.arrays import U8

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
MESH = "shape_msgs/msg/Mesh"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
PUPPETS = "flowing_puppet_msgs/msg/PuppetArray"
BODIES = "flowing_puppet_msgs/msg/BodyArray"
MEASUREMENTS = "flowing_puppet_msgs/msg/BodyMeasurementsArray"
IDS_LIST = "hri_msgs/msg/IdsList"
SKELETON_2D = "hri_msgs/msg/Skeleton2D"
SILHOUETTES = "flowing_puppet_msgs/msg/SilhouetteSet"
DETECTIONS_2D = "vision_msgs/msg/Detection2DArray"
PEOPLE = "people_msgs/msg/People"
PERSON_POSE = "geometry_msgs/msg/PoseStamped"
ANNOTATIONS = "foxglove_msgs/msg/ImageAnnotations"


class MessageFactory(Protocol):
    """Factory of ROS messages of one kind (those of rclpy or of the bag library)."""

    def make(self, type_name: str, **values: Any) -> Any:
        """Make a message of type `package/msg/Name`; arrays of numbers are given as ndarray, other arrays as lists."""
        ...

    def __hash__(self) -> int:
        """Return a hash of this factory: what is made once for all may be kept by it."""
        ...


def message_bytes(data: Any) -> U8:
    """View a uint8[] field of any kind of message as an array, without a copy."""
    return data.view(np.uint8) if isinstance(data, np.ndarray) else np.frombuffer(memoryview(data), np.uint8)
