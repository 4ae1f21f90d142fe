# SPDX-License-Identifier: Apache-2.0
"""The nodes live: images of a drawn person and clouds of a walking body over loopback DDS, results timed."""

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
from flowing_puppet_ros.evaluate.body.synthetic_scans import surface_samples
from flowing_puppet_ros.model.sp import StitchedPuppet

IMAGE_RATE, CLOUD_RATE = 30.0, 10.0  # Hz
IMAGE_COUNT, CLOUD_COUNT = 90, 40
POINTS, NOISE, STEP, TURN = 5000, 0.003, 0.03, 0.02  # points, metres, metres and radians a cloud
TARGETS = {
    "puppet_tracker": "15 Hz, median 150 ms, lock-on 10 s",
    "body_fitter": "5 Hz, lock-on 10 s",
}
_ARGUMENTS = {"puppet_tracker": ("-p", "preset:=fast"), "body_fitter": ("-p", "track:=true")}
_ROS_OF_WHEELS = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"


def images() -> np.ndarray:
    """Return (N,480,640,3) images of a person who waves, one image period apart."""
    person = DrawnPerson((640, 480))
    return np.stack([person.image(number / IMAGE_RATE) for number in range(IMAGE_COUNT)])


def clouds(seed: int = 0) -> np.ndarray:
    """Return (N,P,3) clouds in metres of a random body of the shipped model that walks and turns."""
    model, rng = StitchedPuppet.load(), np.random.default_rng(seed)
    body = model.sample(rng)
    found = []
    for number in range(CLOUD_COUNT):
        angle = TURN * number
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
        center = (body.center - body.center[0]) @ turn.T + body.center[0] + np.array([STEP * number, 0.0, 0.0])
        state = replace(body, center=center, rotation=turn @ body.rotation)
        points, _ = surface_samples(model.vertices(state), model.faces, rng, POINTS)
        found.append(points + NOISE * rng.standard_normal(points.shape))
    return np.stack(found).astype(np.float32)


def run(seconds: float, seed: int = 0) -> list[dict[str, Any]]:
    """Return one row a node, each measured for `seconds`; InputError when there is no ROS here."""
    if importlib.util.find_spec("rclpy") is None:
        raise InputError("bench live needs rclpy: source a ROS 2 Jazzy, or run `make venv` in the source tree")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "input.npz"
        for node, array, rate in (("puppet_tracker", "images", IMAGE_RATE), ("body_fitter", "clouds", CLOUD_RATE)):
            arrays: Any = {array: images() if array == "images" else clouds(seed)}
            np.savez(file, **arrays)
            rows.append(_measured(node, file, rate, seconds) | {"target": TARGETS[node]})
    return rows


def _measured(node: str, file: Path, rate: float, seconds: float) -> dict[str, Any]:
    measure = [sys.executable, "-m", "benchmarks.live_node", node, str(file)]
    command = [*measure, "--rate", str(rate), "--seconds", str(seconds), "--", *_ARGUMENTS[node]]
    # An own domain on this machine only: nobody else's topics are met.
    environment = os.environ | {
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }  # fmt: skip
    environment.pop(_ROS_OF_WHEELS, None)
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, env=environment)
    if done.returncode:
        raise PuppetError(f"the live measurement of {node} failed; see above")
    return dict(json.loads(done.stdout))
