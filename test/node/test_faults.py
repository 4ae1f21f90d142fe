# SPDX-License-Identifier: Apache-2.0
"""What the outside world can send, over DDS to nodes in processes of their own: each fault one diagnostic, no harm."""

import array
import copy
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from flowing_puppet_msgs.msg import BodyArray, Puppet, PuppetArray, PuppetJoint
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from benchmarks.drawn_person import JOINTS, DrawnPerson
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.node.factory import RosMessageFactory
from flowing_puppet_ros.stream.component import base_topic
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header
from flowing_puppet_ros.stream.messages.images import make_image
from test.node.conftest import QUICK_FIT, Peer, arguments, running_nodes

pytestmark = pytest.mark.ros
FACTORY = RosMessageFactory()
PERSON = DrawnPerson((160, 120))


class World:
    """The nodes, a peer that feeds them, and what they say."""

    def __init__(self, peer: Peer, logs: dict[str, Path]) -> None:
        """Listen to everything."""
        self.peer, self.logs = peer, logs
        self.time = 10**9
        self.results: dict[str, list[Any]] = {"puppets": [], "bodies": []}
        self.reports: dict[str, DiagnosticStatus] = {}
        self.worst: dict[str, bytes] = {}
        for topic, kind in (("puppets", PuppetArray), ("bodies", BodyArray)):
            peer.create_subscription(kind, topic, self.results[topic].append, 50)
        peer.create_subscription(DiagnosticArray, "/diagnostics", self._report, 50)
        self.feeds: dict[str, Any] = {}

    def _report(self, message: DiagnosticArray) -> None:
        for status in message.status:
            node = status.hardware_id.lstrip("/")
            self.reports[node] = status
            self.worst[node] = max(self.worst.get(node, b"\0"), status.level)

    def value(self, node: str, key: str) -> float:
        """Return a figure of a node's newest report."""
        values = {item.key: item.value for item in self.reports[node].values} if node in self.reports else {}
        return float(values.get(key, 0))

    def header(self) -> Any:
        """Return a header a thirtieth of a second after the last."""
        self.time += 33_000_000
        return make_header(FACTORY, self.time, "sensor")

    def send(self, topic: str, message: Any) -> None:
        """Publish on a topic that a node has subscribed to; of an image, nobody publishes the other transport then."""
        if topic not in self.feeds:
            for other in [name for name in self.feeds if base_topic(name) == base_topic(topic)]:
                self.peer.destroy_publisher(self.feeds.pop(other))
            feed = self.feeds[topic] = self.peer.create_publisher(type(message), topic, 50)
            self.peer.spin_until(feed.get_subscription_count, f"a subscriber of {topic}")
            self.peer.spin_for(0.3)
        self.feeds[topic].publish(message)

    @contextmanager
    def fault(self, node: str, key: str = "unusable") -> Iterator[None]:
        """Wait until what is sent inside is counted by the node under `key`."""
        before = self.value(node, key)
        yield
        self.peer.spin_until(lambda: self.value(node, key) > before, f"{key} of {node} after {before}")

    def works(self, topic: str, feed: str, message: Any) -> Any:
        """Send good input until a result with somebody comes; return it."""
        count = len(self.results[topic])

        def answered() -> list[Any]:
            """Send once more, and return the results with somebody."""
            message.header = self.header()
            self.send(feed, message)
            if topic == "puppets":
                self.send("detections", detections(message.header))
            self.peer.spin_for(0.3)
            return [result for result in self.results[topic][count:] if getattr(result, topic)]

        self.peer.spin_until(answered, f"somebody on {topic}")
        return answered()[-1]


def detections(header: Any) -> PuppetArray:
    """Return where the drawn person stands."""
    joints = [
        PuppetJoint(name=name, x=float(x), y=float(y), confidence=1.0)
        for name, (x, y) in zip(JOINTS, PERSON.locate_joints(0.0), strict=True)
    ]
    return PuppetArray(header=header, puppets=[Puppet(joints=joints)])


def image(header: Any) -> Image:
    """Return an image of the person."""
    return make_image(FACTORY, header, PERSON.draw(0.0), "rgb8")


def kept(topic: str) -> dict[str, str]:
    """Return parameters under which a sensor topic loses nothing on the way."""
    prefix = f"qos_overrides.{topic}.subscription"
    return {f"{prefix}.reliability": "reliable", f"{prefix}.depth": "50"}


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """Return a tracker and a fitter that every test of this file speaks to."""
    rclpy.init()
    peer = Peer()
    try:
        with running_nodes(tmp_path_factory.mktemp("logs")) as run:
            logs = {}
            for name, settings, topics in (
                ("puppet_tracker", {}, ("/image", "/detections")),
                ("body_fitter", QUICK_FIT, ("/points", "/depth", "/camera_info")),
            ):
                given = {"queue": 5, **settings}
                for topic in topics:
                    given |= kept(topic)
                logs[name] = run(name, *arguments(given))
            made = World(peer, logs)
            peer.spin_until(lambda: len(made.reports) == 2, "reports of both nodes")
            yield made
            assert all(b"\0" <= level < DiagnosticStatus.ERROR or level == DiagnosticStatus.STALE
                       for level in made.worst.values()), f"{made.reports}"  # fmt: skip
    finally:
        peer.destroy_node()
        rclpy.try_shutdown()


def spoilt_images() -> dict[str, Any]:
    """Images that say something that is not so."""
    good = image(make_header(FACTORY, 0, "sensor"))
    changes: dict[str, dict[str, Any]] = {
        "zero size": {"height": 0, "width": 0, "step": 0, "data": array.array("B")},
        "gigantic": {"height": 2**31, "width": 2**31, "step": 2**32 - 1},
        "step too small": {"step": 7},
        "step too large": {"step": 2**32 - 1},
        "data too short": {"data": good.data[:-1]},
        "no data": {"data": array.array("B")},
        "unknown encoding": {"encoding": "16SC7"},
        "no encoding": {"encoding": ""},
        "two by two": {"height": 2, "width": 2, "step": 6, "data": good.data[:12]},
    }
    spoilt = {}
    for name, fields in changes.items():
        spoilt[name] = copy.copy(good)
        for field, value in fields.items():
            setattr(spoilt[name], field, value)
    return spoilt


def test_images_that_lie(world: World) -> None:
    for message in spoilt_images().values():
        with world.fault("puppet_tracker"):
            message.header = world.header()
            world.send("image", message)
    found = world.works("puppets", "image", image(world.header()))
    assert found.header.frame_id == "sensor"
    last = {item.key: item.value for item in world.reports["puppet_tracker"].values}
    assert "last error" in last


def test_compressed_images_of_garbage(world: World) -> None:
    for data in (b"", b"\xff\xd8\xff\xe0 no more", bytes(10_000)):
        with world.fault("puppet_tracker"):
            garbage = CompressedImage(header=world.header(), format="jpeg", data=array.array("B", data))
            # Best effort may lose one; it is said again.
            for _ in range(3):
                world.send("image/compressed", garbage)


def test_detections_and_flow_of_no_use(world: World) -> None:
    nan = float("nan")
    header = world.header()
    joints = [PuppetJoint(name=name, x=nan, y=math.inf, confidence=nan) for name in JOINTS]
    wild = [PuppetJoint(name=name, x=1e30, y=-1e30, confidence=7.0) for name in JOINTS]
    people = [Puppet(joints=joints), Puppet(joints=wild), Puppet(), Puppet(joints=[PuppetJoint(name="tail")])]
    world.send("image", image(header))
    world.send("detections", PuppetArray(header=header, puppets=people * 100))
    for pixels, encoding in (
        (np.full((5, 7, 2), np.nan, np.float32), "32FC2"),
        (np.full((240, 320, 2), np.inf, np.float32), "32FC2"),
        (np.full((120, 160, 2), 1e30, np.float32), "32FC2"),
        (np.zeros((120, 160), np.uint8), "mono8"),
    ):
        flow = make_image(FACTORY, world.header(), pixels, encoding)
        world.send("flow/forward", flow)
        flow.header = world.header()
        world.send("flow/backward", flow)
        following = image(flow.header)
        world.send("image", following)
        world.send("detections", detections(flow.header))
    found = world.works("puppets", "image", image(world.header()))
    for name in ("flow/forward", "flow/backward"):
        world.peer.destroy_publisher(world.feeds.pop(name))
    assert all(is_finite(result) for result in world.results["puppets"])
    assert is_finite(found)


def is_finite(message: Any) -> bool:
    """Whether every number of a puppet message is one; places of unknown joints are never NaN."""
    return all(
        math.isfinite(value)
        for puppet in message.puppets
        for values in (
            (puppet.scale, puppet.energy, puppet.confidence),
            *((joint.x, joint.y, joint.confidence) for joint in puppet.joints),
            *(part.contour for part in puppet.parts),
        )
        for value in values
    )


def test_a_burst_of_a_thousand_images_is_thinned_and_the_newest_wins(world: World) -> None:
    with world.fault("puppet_tracker", "received image"):
        for _ in range(1000):
            world.send("image", image(world.header()))
    newest = world.time
    world.send("detections", detections(make_header(FACTORY, newest, "sensor")))
    arrived = world.results["puppets"]
    world.peer.spin_until(lambda: any(stamp(result) == newest for result in arrived), "the newest image's result")


def stamp(message: Any) -> int:
    """Return a stamp in nanoseconds."""
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


def test_stamps_that_stand_still_go_back_or_are_zero(world: World) -> None:
    world.works("puppets", "image", image(world.header()))
    with world.fault("puppet_tracker", "disordered images"):
        late = image(make_header(FACTORY, world.time - 20_000_000, "sensor"))
        world.send("image", late)
    with world.fault("puppet_tracker", "stamps of zero"):
        world.send("image", image(make_header(FACTORY, 0, "sensor")))
    with world.fault("puppet_tracker", "stamps from the future"):
        world.send("image", image(make_header(FACTORY, 2**31 * 10**9 - 1, "sensor")))
    for _ in range(3):
        world.send("image", image(make_header(FACTORY, world.time, "sensor")))
    world.works("puppets", "image", image(world.header()))
    log = world.logs["puppet_tracker"].read_text()
    assert "stamps of zero" in log and "from the future" in log and "the stamp went back" in log


def spoilt_clouds() -> list[Any]:
    """Clouds that say something that is not so, or have no point that could be used."""
    header = make_header(FACTORY, 0, "sensor")
    rng = np.random.default_rng(0)
    clouds = [make_cloud(FACTORY, header, np.full((500, 3), value)) for value in (np.nan, np.inf, -np.inf)]
    clouds.append(PointCloud2(header=header))
    good = make_cloud(FACTORY, header, rng.uniform(-0.8, 0.8, (500, 3)))
    changes: tuple[tuple[str, Any], ...] = (
        ("width", 2**32 - 1), ("point_step", 0), ("point_step", 2**32 - 1), ("height", 3), ("fields", []),
        ("data", array.array("B")), ("fields", good.fields[:2]),
    )  # fmt: skip
    for field, value in changes:
        clouds.append(copy.copy(good))
        setattr(clouds[-1], field, value)
    return clouds


def empty_clouds() -> list[Any]:
    """Clouds of numbers in which nobody can be."""
    header = make_header(FACTORY, 0, "sensor")
    rng = np.random.default_rng(0)
    everywhere, flat = rng.uniform(-50, 50, (500, 3)), rng.uniform(-0.8, 0.8, (500, 3)) * (1, 1, 0)
    return [make_cloud(FACTORY, header, points) for points in (everywhere, flat, 0 * flat, 0 * flat + 1e30)]


def body(header: Any) -> PointCloud2:
    """Return the cloud of a body."""
    model = StitchedPuppet.load()
    points = model.vertices(model.sample(np.random.default_rng(3), pose_scale=0.3))
    return make_cloud(FACTORY, header, points[::4])


def test_clouds_that_lie(world: World) -> None:
    before = len(world.results["bodies"])
    clouds = spoilt_clouds()
    for cloud in clouds:
        with world.fault("body_fitter"):
            cloud.header = world.header()
            world.send("points", cloud)
    for cloud in empty_clouds():  # one by one: of several that wait, only the newest is answered
        count = len(world.results["bodies"]) + 1
        cloud.header = world.header()
        world.send("points", cloud)
        world.peer.spin_until(lambda count=count: len(world.results["bodies"]) >= count, "an answer")  # type: ignore[misc]
    assert len(world.results["bodies"]) >= before + len(clouds) + len(empty_clouds())
    assert not any(answer.bodies for answer in world.results["bodies"][before:])
    found = world.works("bodies", "points", body(world.header()))
    assert all(math.isfinite(v) for j in found.bodies[0].joints for v in (j.position.x, j.position.y, j.position.z))


def test_depth_without_a_calibration(world: World) -> None:
    depth = make_image(FACTORY, world.header(), np.full((48, 64), 1500, np.uint16), "16UC1")
    for info in (CameraInfo(width=64, height=48), CameraInfo(width=7, height=48, k=np.eye(3).ravel() * 50)):
        with world.fault("body_fitter"):
            depth.header = info.header = world.header()
            world.send("camera_info", info)
            world.send("depth", depth)
    assert "uncalibrated (k and p are all zero)" in world.logs["body_fitter"].read_text()


def test_compressed_depth_of_garbage(world: World) -> None:
    info = CameraInfo(width=64, height=48, k=np.array([50.0, 0, 32, 0, 50, 24, 0, 0, 1]))
    for data in (b"", bytes(12) + b"\x89PNG no more", bytes(10_000)):
        with world.fault("body_fitter"):
            garbage = CompressedImage(format="16UC1; compressedDepth png", data=array.array("B", data))
            for _ in range(3):
                garbage.header = info.header = world.header()
                world.send("camera_info", info)
                world.send("depth/compressedDepth", garbage)
    assert "a compressed depth image of" in world.logs["body_fitter"].read_text()


def test_a_publisher_that_dies_and_returns(world: World) -> None:
    world.works("puppets", "image", image(world.header()))
    for topic in ("image", "detections", "image/compressed"):
        if topic in world.feeds:
            world.peer.destroy_publisher(world.feeds.pop(topic))

    def silent() -> bool:
        report = world.reports["puppet_tracker"]
        return report.level == DiagnosticStatus.STALE and "/image (0)" in report.message

    world.peer.spin_until(silent, "the report of the silence")
    world.works("puppets", "image", image(world.header()))
    world.peer.spin_until(
        lambda: world.reports["puppet_tracker"].level in (DiagnosticStatus.OK, DiagnosticStatus.WARN), "recovery"
    )
