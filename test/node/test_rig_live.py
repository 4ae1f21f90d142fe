# SPDX-License-Identifier: Apache-2.0
"""A body fitter as a node that gets depth images and silhouettes: one body from both, as without ROS."""

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_circle import (  # type: ignore[import-not-found]
    ANGLES,
    DEPTHS,
    LIMBS,
    MAN,
    TENTH,
    frames_of,
    messages_of,
    silhouettes_at,
)
from rclpy.qos import QoSProfile

from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.node.factory import message_type
from flowing_puppet_ros.stream.messages import message_types
from flowing_puppet_ros.stream.messages.geometry import stamp_ns
from flowing_puppet_ros.stream.messages.puppets import decode_body_joints
from test.node.conftest import arguments

pytestmark = pytest.mark.ros
STAMPS = [number * TENTH for number in range(10, 13)]
TOPICS = {
    "/tf_static": message_types.TRANSFORMS,
    "/cam0/camera_info": message_types.CAMERA_INFO,
    "/cam0/depth": message_types.IMAGE,
    "/silhouettes": message_types.SILHOUETTES,
}


def write_bag(path: Path) -> None:
    """Write one depth camera's images of the man, and his silhouettes in three colour cameras 50 ms later."""
    with BagWriter(path) as writer:
        for topic, kind in TOPICS.items():
            writer.add_topic(topic, kind)
        writer.write("/tf_static", STAMPS[0], frames_of(ANGLES))
        for stamp in STAMPS:
            for port, message in messages_of(0, stamp, DEPTHS[0]):
                writer.write(f"/{port}", stamp, message)
            writer.write("/silhouettes", stamp + TENTH // 2, silhouettes_at(stamp))


def test_a_node_joins_depth_with_the_silhouettes_that_come_later(
    start: Callable[..., Path], peer: Any, tmp_path: Path
) -> None:
    write_bag(tmp_path / "in.mcap")
    found: dict[int, list[Any]] = {}
    kind = message_type(message_types.BODIES)
    peer.create_subscription(
        kind, "/bodies", lambda message: found.update({stamp_ns(message): list(message.bodies)}), QoSProfile(depth=50)
    )
    kept = {"rig.cameras": "cam0", "queue": 50}
    for topic in ("/cam0/depth", "/cam0/camera_info"):
        kept |= {f"qos_overrides.{topic}.subscription.reliability": "reliable"}
    start("body_fitter", *arguments(kept))
    peer.spin_until(lambda: peer.count_publishers("/bodies"), "the node")
    script = Path(__file__).with_name("publish_bag.py")
    with subprocess.Popen([sys.executable, script, tmp_path / "in.mcap", "1.0"]) as publisher:
        try:
            peer.spin_until(lambda: found.keys() >= {STAMPS[-1]}, "bodies")
        finally:
            publisher.send_signal(signal.SIGINT)
    last = found[STAMPS[-1]]
    assert [body.id for body in last] == ["a7"]
    joints = decode_body_joints(last[0])
    assert np.mean([np.linalg.norm(np.array(joints[name][:3]) - MAN[name]) for name in LIMBS]) < 0.045
