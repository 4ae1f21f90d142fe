# SPDX-License-Identifier: Apache-2.0
"""What nodes do with bad messages, jumps of time, resets, goals and bad parameters: one sentence, and they live on."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray
from flowing_puppet_msgs.action import FitBody
from flowing_puppet_msgs.msg import BodyArray
from rclpy.action import ActionClient
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image, PointCloud2
from std_srvs.srv import Trigger

from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.node.factory import RosMessageFactory
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header
from flowing_puppet_ros.stream.messages.images import make_image
from test.node.conftest import QUICK_FIT, arguments

pytestmark = pytest.mark.ros
FACTORY = RosMessageFactory()


def image(number: int, encoding: str = "rgb8") -> Image:
    """Return an image of a texture that moves two pixels to the right with each number."""
    texture = np.kron(np.random.default_rng(0).integers(0, 255, (12, 16, 3)), np.ones((10, 10, 1))).astype(np.uint8)
    header = make_header(FACTORY, 1_000_000_000 + number * 33_000_000, "camera")
    return make_image(FACTORY, header, np.roll(texture, 2 * number, axis=1), encoding)


def median(flow: Image) -> list[float]:
    """Return the median of a flow field, rounded to a pixel."""
    field = np.frombuffer(flow.data, "<f4").reshape(flow.height, flow.width, 2)
    return [float(c) for c in np.round(np.median(field, axis=(0, 1)))]


def received(peer: Any, kind: Any, topic: str) -> list[Any]:
    """Return the list into which messages of a topic will come."""
    found: list[Any] = []
    peer.create_subscription(kind, topic, found.append, 50)
    return found


def connected(peer: Any, kind: Any, topic: str) -> Any:
    """Return a publisher that somebody listens to, when all that `peer` listens to has a publisher, too."""
    publisher = peer.create_publisher(kind, topic, 50)
    peer.spin_until(publisher.get_subscription_count, f"a subscriber of {topic}")
    for each in peer.subscriptions:
        peer.spin_until(lambda name=each.topic_name: peer.count_publishers(name), f"a publisher of {each.topic_name}")
    peer.spin_for(0.5)
    return publisher


def kept(topic: str) -> list[str]:
    """Return ROS arguments under which no message of a sensor topic is lost."""
    prefix = f"qos_overrides.{topic}.subscription"
    return ["-p", f"{prefix}.reliability:=reliable", "-p", f"{prefix}.depth:=50", "-p", "queue:=50"]


def test_flow_survives_bad_images_and_starts_anew_on_request(start: Callable[..., Path], peer: Any) -> None:
    topic = "/camera/image_raw"
    log = start("optical_flow", "-r", f"image:={topic}", *kept(topic))
    flows = received(peer, Image, "flow/forward")
    reports = received(peer, DiagnosticArray, "/diagnostics")
    raw = connected(peer, Image, topic)
    peer.spin_until(lambda: peer.count_publishers("flow/forward"), "the output")
    short = image(2)
    short.height += 1
    raw.publish(image(0))
    raw.publish(short)
    raw.publish(image(2, "8UC9"))
    raw.publish(Image())
    for number in (-101, -100):
        raw.publish(image(number))
    peer.spin_until(lambda: flows, "flow of images from before the epoch")
    for number in (3, 4, 5):
        raw.publish(image(number))
    peer.spin_until(lambda: len(flows) > 1 and median(flows[-1]) == [2.0, 0.0], "flow after bad images")
    count = len(flows)
    client = peer.create_client(Trigger, "optical_flow/reset")
    answer = client.call_async(Trigger.Request())
    peer.spin_until(answer.done, "the reset")
    assert answer.result().success
    raw.publish(image(9))
    raw.publish(image(10))
    peer.spin_until(lambda: len(flows) > count, "flow after the reset")
    assert median(flows[count]) == [2.0, 0.0], "the pair across the reset gives no flow"
    assert "8UC9" in log.read_text()
    peer.spin_until(lambda: value(reports, "unusable") == "3", "the count of bad images on /diagnostics")


def value(reports: list[Any], key: str) -> str | None:
    """Return a value of the newest report of the node."""
    return next((item.value for item in reports[-1].status[0].values if item.key == key), None) if reports else None


def test_time_that_jumps_back_starts_anew(start: Callable[..., Path], peer: Any) -> None:
    log = start("optical_flow", "-p", "use_sim_time:=true")
    clock = connected(peer, Clock, "/clock")
    peer.spin_until(lambda: "ready" in log.read_text(), "the node")
    for seconds in (100, 101, 50):
        clock.publish(Clock(clock=clock_time(seconds)))
        peer.spin_for(0.3)
    peer.spin_until(lambda: "jumped back" in log.read_text(), "the notice of the jump")


def clock_time(seconds: int) -> Any:
    """Return a builtin_interfaces/Time."""
    return FACTORY.make("builtin_interfaces/msg/Time", sec=seconds)


def body_cloud(stamp: int) -> PointCloud2:
    """Return the vertices of a sampled body as a cloud."""
    model = StitchedPuppet.load()
    points = model.vertices(model.sample(np.random.default_rng(3), pose_scale=0.3))
    return make_cloud(FACTORY, make_header(FACTORY, stamp, "world"), points)


def test_fitter_survives_bad_clouds_and_serves_goals(start: Callable[..., Path], peer: Any) -> None:
    start("body_fitter", *arguments(QUICK_FIT), *kept("/points"))
    bodies = received(peer, BodyArray, "bodies")
    points = connected(peer, PointCloud2, "points")
    # One after the other: a node that is behind goes on with the newest cloud.
    points.publish(PointCloud2(header=make_header(FACTORY, 1_000_000_000, "world")))
    peer.spin_until(lambda: len(bodies) == 1, "an answer without bodies")
    points.publish(make_cloud(FACTORY, make_header(FACTORY, 2_000_000_000, "world"), np.full((50, 3), np.nan)))
    peer.spin_until(lambda: len(bodies) == 2, "another answer without bodies")
    assert [len(found.bodies) for found in bodies] == [0, 0]

    def found() -> bool:
        """Send the cloud again: somebody new is searched for beside the clouds that come."""
        points.publish(body_cloud(3_000_000_000 + 100_000_000 * len(bodies)))
        peer.spin_for(0.5)
        return bool(bodies[-1].bodies)

    peer.spin_until(found, "a body")
    assert len(bodies[-1].bodies) == 1
    assert bodies[-1].header.frame_id == "world"
    client = ActionClient(peer, FitBody, "fit_body")
    peer.spin_until(client.server_is_ready, "the action")
    assert goal(peer, client, PointCloud2())[0].message
    result, feedback = goal(peer, client, body_cloud(4_000_000_000))
    assert result.message == ""
    assert len(result.bodies.bodies) == 1
    progress = [item.feedback.progress for item in feedback]
    assert progress == sorted(progress)
    assert progress[-1] == 1.0


def goal(peer: Any, client: ActionClient, cloud: PointCloud2) -> tuple[FitBody.Result, list[Any]]:
    """Send a goal; return its result and the feedback that came."""
    feedback: list[Any] = []
    done = sent(peer, client, cloud, feedback.append).get_result_async()
    peer.spin_until(done.done, "the goal's result")
    return done.result().result, feedback


def sent(peer: Any, client: ActionClient, cloud: PointCloud2, feedback: Callable[[Any], None] | None = None) -> Any:
    """Send a goal; return its handle."""
    accepted = client.send_goal_async(FitBody.Goal(cloud=cloud, seed=1), feedback)
    peer.spin_until(accepted.done, "the goal's acceptance")
    return accepted.result()


def test_goals_that_wait_can_be_cancelled_and_do_not_outlive_the_node(start: Callable[..., Path], peer: Any) -> None:
    start("body_fitter", *arguments(QUICK_FIT | {"fitter.iterations": 10000}))
    client = ActionClient(peer, FitBody, "fit_body")
    peer.spin_until(client.server_is_ready, "the action")
    feedback: list[Any] = []
    first = sent(peer, client, body_cloud(1), feedback.append)
    second = sent(peer, client, body_cloud(2))
    third = sent(peer, client, body_cloud(3))
    peer.spin_until(lambda: len(feedback) > 1, "the first fit")
    for handle in (second, first):
        answer = handle.cancel_goal_async()
        peer.spin_until(answer.done, "the answer to the cancellation")
        assert len(answer.result().goals_canceling) == 1
    for handle in (first, second):
        done = handle.get_result_async()
        peer.spin_until(done.done, "the end of the goal")
        assert done.result().status == GoalStatus.STATUS_CANCELED
        assert done.result().result.message == "cancelled"
    third.get_result_async()
    peer.spin_for(0.5)
    # The third is being fitted when the interrupt comes.


REFUSED = [
    ("optical_flow", ["--ros-args", "-p", "max_side:=3"], "max_side"),
    ("optical_flow", ["--ros-args", "-p", "preset:=best"], "best"),
    ("optical_flow", ["--ros-args", "-p", "use_sim_time:=5"], "use_sim_time"),
    ("optical_flow", ["--ros-args", "-p", "qos_overrides./image.subscription.reliability:=good"], "good"),
    ("visual_hull", [], "cameras"),
    ("visual_hull", ["--ros-args", "-p", "cameras:=a b,c"], "a b/image"),
    ("body_fitter", ["--ros-args", "--params-file", "nowhere.yaml"], "nowhere.yaml"),
]
# In a process of its own, since a node that was refused may leave publishers behind that other tests would see.
REFUSE = """
import contextlib, io, json, sys
from flowing_puppet_ros.node import main
answers = []
for name, given, _ in json.loads(sys.argv[1]):
    with contextlib.redirect_stderr(io.StringIO()) as said:
        status = getattr(main, name)(given)
    answers.append((status, said.getvalue()))
print(json.dumps(answers))
"""


def test_bad_parameters_are_one_sentence(tmp_path: Path) -> None:
    command = [sys.executable, "-c", REFUSE, json.dumps(REFUSED)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=True)
    assert done.stderr == ""
    for (name, _, named), (status, said) in zip(REFUSED, json.loads(done.stdout), strict=True):
        assert status == 2, name
        assert named in said
        assert len(said.strip().splitlines()) == 1


def test_an_installed_program_exits_with_its_status(tmp_path: Path) -> None:
    command = [str(Path(sys.executable).with_name("visual_hull")), "--ros-args", "-p", "cameras:=one"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2
    assert "cameras is 'one'" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_help_lists_the_parameters() -> None:
    command = [str(Path(sys.executable).with_name("puppet_tracker")), "--help"]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "overlay_max_side [960]" in shown
    assert "queue [1]" in shown
