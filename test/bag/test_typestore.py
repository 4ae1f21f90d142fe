# SPDX-License-Identifier: Apache-2.0
"""The factory of bag messages, and the types it knows."""

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from flowing_puppet_ros.bag.typestore import BagMessageFactory, definition_files, typestore

FACTORY = BagMessageFactory()


def test_fields_without_a_value_are_zero_and_serialise() -> None:
    for name in (
        "sensor_msgs/msg/CameraInfo",
        "visualization_msgs/msg/MarkerArray",
        "visualization_msgs/msg/Marker",
        "flowing_puppet_msgs/msg/BodyArray",
        "tf2_msgs/msg/TFMessage",
        "hri_msgs/msg/Skeleton2D",
        "vision_msgs/msg/Detection2DArray",
        "foxglove_msgs/msg/ImageAnnotations",
    ):
        message = FACTORY.make(name)
        again = typestore().deserialize_cdr(typestore().serialize_cdr(message, name), name)
        assert typestore().serialize_cdr(again, name) == typestore().serialize_cdr(message, name)
    assert FACTORY.make("sensor_msgs/msg/CameraInfo").k.tolist() == [0.0] * 9


def test_numbers_are_what_the_wire_carries() -> None:
    joint = FACTORY.make("flowing_puppet_msgs/msg/PuppetJoint", name="nose", x=0.1, y=np.float64(2), confidence=1)
    assert joint.x == float(np.float32(0.1)) != 0.1
    part = FACTORY.make("flowing_puppet_msgs/msg/PuppetPart", contour=np.array([[1.0, 2], [3, 4]]))
    assert part.contour.dtype == np.float32
    assert part.contour.tolist() == [1, 2, 3, 4]


def test_unknown_fields_are_refused() -> None:
    with pytest.raises(TypeError, match="has no field 'colour'"):
        FACTORY.make("std_msgs/msg/Header", colour="red")


HRI_MSGS = {
    "IdsList": "std_msgs/Header header\nstring[] ids",
    "NormalizedPointOfInterest2D": "float32 x\nfloat32 y\nfloat32 c",
    "NormalizedRegionOfInterest2D": "std_msgs/Header header" + "".join(
        f"\nfloat32 {name}" for name in ("xmin", "ymin", "xmax", "ymax", "c")
    ),
    "Skeleton2D": "std_msgs/Header header\nNormalizedPointOfInterest2D[18] skeleton",
}  # fmt: skip
"""The fields of the ROS 2 versions of hri_msgs. A type's hash is made of them, not of constants and comments."""


def test_the_stand_in_for_hri_msgs_has_its_hashes() -> None:
    assert {path.stem for path in definition_files("hri_msgs")} == set(HRI_MSGS)
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in HRI_MSGS.items():
        store.register(get_types_from_msg(text, f"hri_msgs/msg/{name}"))
    for name in HRI_MSGS:
        assert typestore().hash_rihs01(f"hri_msgs/msg/{name}") == store.hash_rihs01(f"hri_msgs/msg/{name}")


def test_messages_of_others_are_those_that_they_publish() -> None:
    """The hashes are those of ROS 2 Jazzy's packages: foxglove_msgs 3.4.3 and vision_msgs 4.1.1."""
    assert typestore().hash_rihs01("foxglove_msgs/msg/ImageAnnotations") == (
        "RIHS01_bc4e578b1ef80953415d6f966a4cab305c8a44c8b64fc405312b6f06a08fc45e"
    )
    # Known is the hash of the detection in space, which has the same fields and another box.
    texts = {path.stem: path.read_text() for path in definition_files("vision_msgs")}
    texts["BoundingBox3D"] = "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n"
    texts["Detection3D"] = texts["Detection2D"].replace("BoundingBox2D", "BoundingBox3D")
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in texts.items():
        store.register(get_types_from_msg(text, f"vision_msgs/msg/{name}"))
    assert store.hash_rihs01("vision_msgs/msg/Detection3D") == (
        "RIHS01_ddd703be132ab0b69d33121f1bb034132bfbb3b0ac5f9fb1516005ba1c8a265b"
    )
