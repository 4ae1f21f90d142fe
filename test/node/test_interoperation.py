# SPDX-License-Identifier: Apache-2.0
"""Another DDS implementation hears the puppets and bodies, and reads the same numbers out of them.

Cyclone DDS lives in an environment of its own, `bags/cache/interop`, that the test makes where it is missing.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from flowing_puppet_msgs.msg import BodyArray, PuppetArray
from rclpy.qos import QoSProfile

from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.node.factory import RosMessageFactory
from flowing_puppet_ros.stream.messages.geometry import make_header, make_point, make_pose

pytestmark = pytest.mark.ros
FACTORY = RosMessageFactory()
ENVIRONMENT = Path(__file__).resolve().parents[2] / "bags" / "cache" / "interop"
VERSION = "cyclonedds==11.0.1"
DOMAIN = int(os.environ["ROS_DOMAIN_ID"])
# The ROS wheels leave these two in their children; with them another environment's Python would load their libraries.
FOREIGN = ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "LD_LIBRARY_PATH", "PYTHONPATH", "VIRTUAL_ENV", "PYTHONHOME")
# Discovery as ROS does it on one machine: no multicast, the ports of the first participants on the loopback.
LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers></Discovery>"
    "</Domain></CycloneDDS>"
)


def clean_environment() -> dict[str, str]:
    """The environment without what belongs to this Python."""
    return {name: value for name, value in os.environ.items() if name not in FOREIGN}


@pytest.fixture(scope="module")
def other_python() -> Path:
    """The Python of the other implementation's environment."""
    python, stamp = ENVIRONMENT / "bin" / "python", ENVIRONMENT / VERSION
    if not stamp.exists():
        base = str(getattr(sys, "_base_executable", sys.executable))
        for command in (
            [base, "-m", "venv", "--clear", str(ENVIRONMENT)],
            [str(python), "-m", "pip", "install", "-q", "--disable-pip-version-check", VERSION],
        ):
            done = subprocess.run(command, env=clean_environment(), capture_output=True, text=True)
            assert done.returncode == 0, done.stderr
        stamp.touch()
    return python


def puppets() -> PuppetArray:
    joints = [
        FACTORY.make("flowing_puppet_msgs/msg/PuppetJoint", name=name, x=x, y=17.25, confidence=0.5)
        for name, x in (("neck", 3.125), ("left_wrist", float("nan")))
    ]
    part = FACTORY.make(
        "flowing_puppet_msgs/msg/PuppetPart",
        name="torso",
        label=1,
        depth=-3,
        confidence=0.25,
        contour=np.arange(7) / 4,
    )
    puppet = FACTORY.make(
        "flowing_puppet_msgs/msg/Puppet", id="a1", model="neutral-14", scale=72.5, joints=joints, parts=[part]
    )
    header = make_header(FACTORY, 1_500_000_007, "camera")
    return FACTORY.make("flowing_puppet_msgs/msg/PuppetArray", header=header, puppets=[puppet])


def bodies() -> BodyArray:
    model = StitchedPuppet.load()
    state = model.sample(np.random.default_rng(0))
    joints = [
        FACTORY.make(
            "flowing_puppet_msgs/msg/BodyJoint", name=name, position=make_point(FACTORY, place), confidence=0.5
        )
        for name, place in zip(model.joint_names, model.joints(model.vertices(state)), strict=True)
    ]
    parts = [
        FACTORY.make(
            "flowing_puppet_msgs/msg/BodyPart",
            name=name,
            pose=make_pose(FACTORY, state.center[index], state.rotation[index]),
            shape_coefficients=state.shape[index],
            pose_coefficients=state.pose[index],
        )
        for index, name in enumerate(model.tree.names)
    ]
    body = FACTORY.make(
        "flowing_puppet_msgs/msg/Body", id="b1", model="neutral", energy=12.5, joints=joints, parts=parts
    )
    header = make_header(FACTORY, 2_250_000_001, "lidar")
    return FACTORY.make("flowing_puppet_msgs/msg/BodyArray", header=header, bodies=[body, body])


def plain(message: Any) -> Any:
    """The message as what JSON holds."""
    if hasattr(message, "get_fields_and_field_types"):
        return {name: plain(getattr(message, name)) for name in message.get_fields_and_field_types()}
    if isinstance(message, str | int | float):
        return message
    return [plain(item) for item in message]


def test_cyclone_dds_reads_the_same_numbers(
    other_python: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    sent = {"puppets": puppets(), "bodies": bodies()}
    output = tmp_path / "heard"
    with output.open("wb") as stream:
        peer = subprocess.Popen(
            [str(other_python), str(Path(__file__).with_name("dds_peer.py")), str(DOMAIN), "60"],
            env=clean_environment() | {"CYCLONEDDS_URI": LOOPBACK},
            stdout=stream,
            stderr=stream,
        )
    context = rclpy.Context()
    context.init(domain_id=DOMAIN)
    node = rclpy.create_node("sender", context=context)
    try:
        publishers = {
            name: node.create_publisher(type(message), name, QoSProfile(depth=10)) for name, message in sent.items()
        }
        while peer.poll() is None:
            for name, publisher in publishers.items():
                publisher.publish(sent[name])
            time.sleep(0.1)
        assert peer.returncode == 0, output.read_text()
    finally:
        peer.kill()
        peer.wait()
        node.destroy_node()
        context.shutdown()
    # As text, for NaN is not equal to itself.
    found = json.loads(output.read_text().splitlines()[-1])
    for name, message in sent.items():
        assert json.dumps(found[name]) == json.dumps(plain(message)), name
