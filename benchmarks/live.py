# SPDX-License-Identifier: Apache-2.0
"""The nodes live over loopback DDS, timed.

A drawn person, clouds of one and three bodies, scans of a hall with five, RGB-D of two people.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import scenes
from benchmarks.drawn_person import DrawnPerson
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource
from flowing_puppet_ros.evaluate.body.synthetic_scans import sample_surface
from flowing_puppet_ros.evaluate.rgbd.depth_sensor import to_millimetres
from flowing_puppet_ros.evaluate.rgbd.motions import pose_motion
from flowing_puppet_ros.evaluate.rgbd.views import RgbdStudio, look_along
from flowing_puppet_ros.model.sp import StitchedPuppet

RATE_HZ = 30.0  # of images and of clouds
IMAGE_COUNT, CLOUD_COUNT = 90, 40  # played back and forth
CLOUD_POINTS, NOISE_M, STEP_M, TURN_RAD = 5000, 0.003, 0.01, 0.007  # noise is a deviation; step and turn are per cloud
APART_M = 1.5  # between the ways of people
RGBD = "puppet_tracker, body_fitter"
RGBD_COUNT = 45  # moments, played back and forth
CLOUD_PEOPLE = (1, 3)  # in a cloud
SCAN_HZ = 1e9 / scenes.SCAN_NS
TARGETS = {
    (RGBD, 2): "15 Hz, median 120 ms, first body 0.6 s",
    ("puppet_tracker", 1): "15 Hz, median 150 ms, lock-on 10 s",
    ("body_fitter", 1): "20 Hz, lock-on 10 s",
    ("body_fitter", 3): "10 Hz, lock-on 10 s",
    ("body_fitter", scenes.PEOPLE): "10 Hz, first bodies 0.5 s",
}
# The networks find no drawn person, our own detector does.
_TRACKER_ARGUMENTS = ("-p", "flow.preset:=fast", "-p", "detection.source:=own")
_BOOTSTRAP_GUARD = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"


def make_images() -> np.ndarray:
    """Draw images (N, 480, 640, 3) of a person who waves, one image period apart."""
    person = DrawnPerson((640, 480))
    return np.stack([person.draw(number / RATE_HZ) for number in range(IMAGE_COUNT)])


def make_clouds(seed: int = 0, people: int = 1) -> np.ndarray:
    """Sample clouds (N, P, 3) m of random bodies of the shipped model that walk side by side and turn."""
    model, rng = StitchedPuppet.load(), np.random.default_rng(seed)
    bodies = [model.sample(rng) for _ in range(people)]
    found = []
    for number in range(CLOUD_COUNT):
        angle = TURN_RAD * number
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
        clouds = []
        for place, body in enumerate(bodies):
            step = np.array([STEP_M * number, APART_M * place, 0.0])
            center = (body.center - body.center[0]) @ turn.T + body.center[0] + step
            state = replace(body, center=center, rotation=turn @ body.rotation)
            points, _ = sample_surface(model.vertices(state), model.faces, rng, CLOUD_POINTS)
            clouds.append(points + NOISE_M * rng.standard_normal(points.shape))
        found.append(np.concatenate(clouds))
    return np.stack(found).astype(np.float32)


def make_rgbd(seed: int = 0) -> dict[str, Any]:
    """Draw colour and depth of somebody who waves and somebody who walks, and their keypoints with 5 px of noise.

    The room is drawn without them, too.

    The keypoint networks rarely find drawn people, so that the keypoints are published as detections.
    """
    source = BodySource()
    rng = np.random.default_rng(seed)
    places = {"waving": (np.array([0.2, 0.7, 0.0]), np.pi), "walking": (np.array([0.2, -0.5, 0.0]), 0.8 * np.pi)}
    people = [
        [body.translate(place) for body in pose_motion(source, name, rng, RGBD_COUNT, RATE_HZ, yaw)]
        for name, (place, yaw) in places.items()
    ]
    studio = RgbdStudio(source)
    cameras = studio.cameras.place(look_along(np.array([1.0, 0.0, 0.0]), 0.12), np.array([-3.2, 0.0, 1.3]))
    room = studio.furnish(rng, [body for person in people for body in (person[0], person[-1])], cameras)
    frames = [studio.look(rng, [person[number] for person in people], room, cameras) for number in range(RGBD_COUNT)]
    empty = studio.look(rng, [], room, cameras)
    keypoints = [[np.column_stack([seen.pixels, seen.confidence]) for seen in frame.keypoints] for frame in frames]
    return {
        "colour": np.stack([frame.rgb for frame in frames]),
        "depth": np.stack([to_millimetres(frame.depth) for frame in frames]),
        "keypoints": np.array(keypoints),
        "empty_colour": empty.rgb,
        "empty_depth": to_millimetres(empty.depth),
        "matrix": cameras.depth.matrix,
    }


def run(seconds: float, seed: int = 0) -> list[dict[str, Any]]:
    """Measure each node for `seconds`; return one row per node. InputError if ROS is missing."""
    if importlib.util.find_spec("rclpy") is None:
        raise InputError("bench live needs rclpy: source a ROS 2 Jazzy, or run `make venv` in the source tree")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "input.npz"
        np.savez(file, images=make_images())
        rows.append(_measure_node("puppet_tracker", file, seconds, _TRACKER_ARGUMENTS, 1))
        for people in CLOUD_PEOPLE:
            np.savez(file, clouds=make_clouds(seed, people))
            rows.append(_measure_node("body_fitter", file, seconds, ("-p", "track:=true"), people))
        walk = scenes.draw_walk(StitchedPuppet.load(), seed, scenes.ROUND)
        np.savez(file, clouds=stack_scans(walk), round=True)
        arguments = ("-p", "track:=true", "-p", "view:=single")
        rows.append(_measure_node("body_fitter", file, seconds, arguments, scenes.PEOPLE, SCAN_HZ))
        np.savez(file, **make_rgbd(seed))
        command = ["benchmarks.live_rgbd", str(file), "--rate", str(RATE_HZ), "--seconds", str(seconds)]
        rows.append({"node": RGBD} | _measure(command) | {"target": TARGETS[RGBD, 2]})
    return rows


def stack_scans(scans: Sequence[np.ndarray]) -> np.ndarray:
    """Return scans (N, P, 3) m of as many points each as the one with the fewest has, evenly taken."""
    points = min(len(scan) for scan in scans)
    evenly = [scan[np.linspace(0, len(scan) - 1, points).astype(np.int64)] for scan in scans]
    return np.stack(evenly).astype(np.float32)


def _measure_node(
    node: str, file: Path, seconds: float, given: Sequence[str], people: int, rate: float = RATE_HZ
) -> dict[str, Any]:
    """Measure a node with parameters `given` on input that shows so many people."""
    command = ["benchmarks.live_node", node, str(file), "--rate", str(rate), "--seconds", str(seconds)]
    figures = _measure([*command, "--people", str(people), "--", *given])
    return figures | {"target": TARGETS[node, people]}


def _measure(command: list[str]) -> dict[str, Any]:
    """Return the figures that a module of the benchmarks prints."""
    # A domain of its own, on this machine only, so that other topics do not interfere.
    environment = os.environ | {
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }  # fmt: skip
    environment.pop(_BOOTSTRAP_GUARD, None)
    done = subprocess.run([sys.executable, "-m", *command], stdout=subprocess.PIPE, text=True, env=environment)
    if done.returncode:
        raise PuppetError(f"the live measurement {' '.join(command[:2])} failed; see above")
    return dict(json.loads(done.stdout))
