# SPDX-License-Identifier: Apache-2.0
"""What the doctor says of live topics: which nodes to start on what, and what does not connect."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from flowing_puppet_ros.bag.reader import Topic, open_bag
from flowing_puppet_ros.doctor.live import LiveRecording, Publisher, inspect_live
from flowing_puppet_ros.stream.messages.message_types import IMAGE, POINT_CLOUD

GOLDEN = Path(__file__).resolve().parents[2] / "bags" / "golden" / "golden.mcap"


def heard(durability: str) -> LiveRecording:
    """Return the golden recording as if it had been heard, with static transforms of some durability."""
    with open_bag(GOLDEN) as bag:
        records, details = list(bag.messages()), dict(bag.details)
    publishers = {
        name: [Publisher("/player", topic.type, "reliable", durability if name == "/tf_static" else "volatile")]
        for name, topic in details.items()
    }
    details |= {"/front/points": Topic(POINT_CLOUD, 0, ()), "/odd/rgb": Topic(IMAGE, 3, ())}
    return LiveRecording(2.0, details, publishers, records)


def test_nodes_to_start_and_what_is_silent() -> None:
    found = inspect_live(heard("transient_local"))
    commands = [finding.command for finding in found.findings if finding.severity == "ready"]
    assert "puppet_tracker --ros-args -r image:=/cam1/image -r detections:=/cam1/detections" in commands
    assert any(command.startswith("visual_hull --ros-args -p cameras:=cam1,cam2,cam3,cam4") for command in commands)
    said = [finding.sentence for finding in found.findings]
    assert "/front/points has a publisher but was silent for 2 s" in said
    renamed = next(finding for finding in found.findings if finding.sentence.startswith("/odd/rgb is not used"))
    assert renamed.command == "puppet_tracker --ros-args -r image:=/odd/rgb"


def test_publishers_that_offer_too_little_are_named() -> None:
    assert not [each for each in inspect_live(heard("transient_local")).findings if "do not" in each.sentence]
    faults = [each for each in inspect_live(heard("volatile")).findings if "do not connect" in each.sentence]
    assert {fault.severity for fault in faults} == {"error"}
    hull = next(fault for fault in faults if "visual_hull" in fault.sentence)
    assert "/tf_static: /player offers durability volatile, visual_hull asks for more" in hull.sentence
    assert "qos_overrides./tf_static.subscription.durability:=volatile" in hull.command


@pytest.mark.ros
@pytest.mark.slow
def test_a_running_graph_is_heard() -> None:
    pytest.importorskip("rclpy")
    import rclpy
    from rclpy.qos import qos_profile_sensor_data

    from flowing_puppet_ros.node.factory import RosMessageFactory, message_type
    from flowing_puppet_ros.stream.messages.clouds import make_cloud
    from flowing_puppet_ros.stream.messages.geometry import make_header

    rclpy.init()
    factory, node = RosMessageFactory(), rclpy.create_node("driver")
    publisher = node.create_publisher(message_type(POINT_CLOUD), "/lidar/points", qos_profile_sensor_data)
    cloud = make_cloud(factory, make_header(factory, 5, "lidar"), np.ones((30, 3)))
    timer = node.create_timer(0.05, lambda: publisher.publish(cloud))
    listening = subprocess.Popen(
        [sys.executable, "-m", "flowing_puppet_ros", "doctor", "live", "--seconds", "4"],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        while listening.poll() is None:
            rclpy.spin_once(node, timeout_sec=0.1)
    finally:
        listening.kill()
        node.destroy_timer(timer)
        node.destroy_node()
        rclpy.try_shutdown()
    assert listening.stdout is not None
    said = listening.stdout.read()
    assert "$ body_fitter --ros-args -r points:=/lidar/points" in said
    assert "/lidar/points: all messages have one stamp" in said
    assert listening.returncode == 0
