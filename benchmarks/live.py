# SPDX-License-Identifier: Apache-2.0
"""The nodes live: images of a drawn person and clouds of a walking body over loopback DDS, with timed results."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.drawn_person import DrawnPerson
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.evaluate.body.synthetic_scans import sample_surface
from flowing_puppet_ros.model.sp import StitchedPuppet

IMAGE_RATE_HZ, CLOUD_RATE_HZ = 30.0, 10.0
IMAGE_COUNT, CLOUD_COUNT = 90, 40  # played back and forth
CLOUD_POINTS, NOISE_M, STEP_M, TURN_RAD = 5000, 0.003, 0.03, 0.02  # noise is a deviation; step and turn are per cloud
TARGETS = {
    "puppet_tracker": "15 Hz, median 150 ms, lock-on 10 s",
    "body_fitter": "5 Hz, lock-on 10 s",
}
# The networks find no drawn person, our own detector does.
_ARGUMENTS = {
    "puppet_tracker": ("-p", "flow.preset:=fast", "-p", "detection.source:=own"),
    "body_fitter": ("-p", "track:=true"),
}
_BOOTSTRAP_GUARD = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"


def make_images() -> np.ndarray:
    """Draw images (N, 480, 640, 3) of a person who waves, one image period apart."""
    person = DrawnPerson((640, 480))
    return np.stack([person.draw(number / IMAGE_RATE_HZ) for number in range(IMAGE_COUNT)])


def make_clouds(seed: int = 0) -> np.ndarray:
    """Sample clouds (N, P, 3) m of a random body of the shipped model that walks and turns."""
    model, rng = StitchedPuppet.load(), np.random.default_rng(seed)
    body = model.sample(rng)
    found = []
    for number in range(CLOUD_COUNT):
        angle = TURN_RAD * number
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
        center = (body.center - body.center[0]) @ turn.T + body.center[0] + np.array([STEP_M * number, 0.0, 0.0])
        state = replace(body, center=center, rotation=turn @ body.rotation)
        points, _ = sample_surface(model.vertices(state), model.faces, rng, CLOUD_POINTS)
        found.append(points + NOISE_M * rng.standard_normal(points.shape))
    return np.stack(found).astype(np.float32)


def run(seconds: float, seed: int = 0) -> list[dict[str, Any]]:
    """Measure each node for `seconds`; return one row per node. InputError if ROS is missing."""
    if importlib.util.find_spec("rclpy") is None:
        raise InputError("bench live needs rclpy: source a ROS 2 Jazzy, or run `make venv` in the source tree")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "input.npz"
        for node, array, rate in (
            ("puppet_tracker", "images", IMAGE_RATE_HZ),
            ("body_fitter", "clouds", CLOUD_RATE_HZ),
        ):
            arrays: Any = {array: make_images() if array == "images" else make_clouds(seed)}
            np.savez(file, **arrays)
            rows.append(_measure_node(node, file, rate, seconds) | {"target": TARGETS[node]})
    return rows


def _measure_node(node: str, file: Path, rate: float, seconds: float) -> dict[str, Any]:
    measure = [sys.executable, "-m", "benchmarks.live_node", node, str(file)]
    command = [*measure, "--rate", str(rate), "--seconds", str(seconds), "--", *_ARGUMENTS[node]]
    # A domain of its own, on this machine only, so that other topics do not interfere.
    environment = os.environ | {
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }  # fmt: skip
    environment.pop(_BOOTSTRAP_GUARD, None)
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, env=environment)
    if done.returncode:
        raise PuppetError(f"the live measurement of {node} failed; see above")
    return dict(json.loads(done.stdout))
