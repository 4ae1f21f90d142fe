# SPDX-License-Identifier: Apache-2.0
"""The golden recording over DDS, every node and the publisher in a process of its own: the answers of the replay."""

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.qos import QoSProfile

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.replay.replay import ReplayOptions, replay
from flowing_puppet_ros.bag.typestore import typestore
from flowing_puppet_ros.node.factory import message_type
from flowing_puppet_ros.stream.messages.geometry import stamp_ns
from test.node.conftest import arguments

pytestmark = pytest.mark.ros
GOLDEN = Path(__file__).resolve().parents[2] / "bags" / "golden" / "golden.mcap"
CAMERAS = ("cam1", "cam2", "cam3", "cam4")
SETTINGS = {"visual_hull": {"hull_every": 4}, "body_fitter": {"silhouettes.gauss_newton_steps": 3}}
COMPARED = {
    **{f"/{camera}/puppets": "flowing_puppet_msgs/msg/PuppetArray" for camera in CAMERAS},
    "/silhouettes": "flowing_puppet_msgs/msg/SilhouetteSet",
    "/hull": "sensor_msgs/msg/PointCloud2",
    "/hull/joints": "flowing_puppet_msgs/msg/BodyArray",
    "/bodies": "flowing_puppet_msgs/msg/BodyArray",
    "/part_poses": "geometry_msgs/msg/PoseArray",
}


def expected(folder: Path) -> dict[str, dict[int, Any]]:
    """Return topic -> stamp -> message of a replay of the golden bag."""
    out = folder / "out.mcap"
    replay(GOLDEN, out, ReplayOptions(settings=SETTINGS, progress=False))
    found: dict[str, dict[int, Any]] = {topic: {} for topic in COMPARED}
    with open_bag(out) as bag:
        for record in bag.messages(list(COMPARED)):
            found[record.topic][stamp_ns(record.message)] = record.message
    return found


def kept(*topics: str) -> list[str]:
    """Return ROS arguments under which no message of these sensor topics is lost."""
    policies = {"reliability": "reliable", "depth": 50}
    overrides = {f"qos_overrides.{t}.subscription.{name}": value for t in topics for name, value in policies.items()}
    return arguments({"queue": 50, **overrides})


def start_all(start: Callable[..., Path]) -> None:
    """Start a tracker for each camera, the hull and the fitter."""
    images = [f"/{camera}/image/compressed" for camera in CAMERAS]
    infos = [f"/{camera}/camera_info" for camera in CAMERAS]
    for camera, image in zip(CAMERAS, images, strict=True):
        start("puppet_tracker", "-r", f"__ns:=/{camera}", *kept(image, f"/{camera}/detections"))
    hull = {"cameras": ",".join(CAMERAS), **SETTINGS["visual_hull"]}
    start("visual_hull", *arguments(hull), *kept(*images, *infos))
    fitter = arguments(SETTINGS["body_fitter"])
    start("body_fitter", *fitter, *kept())


def equal(a: Any, b: Any) -> bool:
    """Tell whether two messages of the bag library have the same values; NaN equals NaN."""
    if hasattr(a, "__dataclass_fields__"):
        return all(equal(getattr(a, name), getattr(b, name)) for name in a.__dataclass_fields__)
    if isinstance(a, list):
        return len(a) == len(b) and all(map(equal, a, b))
    if isinstance(a, str):
        return a == b
    return np.array_equal(a, b, equal_nan=np.asarray(a).dtype.kind == "f")


def test_live_results_equal_the_replay(start: Callable[..., Path], peer: Any, tmp_path: Path) -> None:
    wanted = expected(tmp_path)
    assert len(wanted["/cam1/puppets"]) == 8
    assert len(wanted["/bodies"]) == 8
    received: dict[str, dict[int, Any]] = {topic: {} for topic in COMPARED}

    def keep(topic: str, raw: bytes) -> None:
        message = typestore().deserialize_cdr(raw, COMPARED[topic])
        received[topic][stamp_ns(message)] = message

    for topic, kind in COMPARED.items():
        kind_class, qos = message_type(kind), QoSProfile(depth=50)
        peer.create_subscription(kind_class, topic, lambda raw, topic=topic: keep(topic, raw), qos, raw=True)
    start_all(start)
    # With the nodes listening to one another, the recording can begin.
    peer.spin_until(lambda: all(peer.count_publishers(topic) for topic in COMPARED), "the nodes")
    peer.spin_until(
        lambda: peer.count_subscribers("/cam4/part_labels") and peer.count_subscribers("/silhouettes") > 1, "joins"
    )
    script = Path(__file__).with_name("publish_bag.py")
    with subprocess.Popen([sys.executable, script, GOLDEN, "0.5"]) as publisher:
        try:
            peer.spin_until(lambda: all(len(received[t]) >= len(wanted[t]) for t in COMPARED), "all results")
        finally:
            publisher.send_signal(signal.SIGINT)
    for topic in COMPARED:
        assert received[topic].keys() == wanted[topic].keys()
        for stamp, message in wanted[topic].items():
            assert equal(message, received[topic][stamp]), f"{topic} at {stamp} differs"
