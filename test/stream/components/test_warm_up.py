# SPDX-License-Identifier: Apache-2.0
"""After the warm-up nothing is loaded or compiled any more, whatever the first messages are; and it leaves no trace."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.stream.components import warm_up
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent, BodyFitterSettings

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[3]
KERNELS = """
import json, sys
from numba.core.dispatcher import Dispatcher
from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent

def state():
    loaded = [(name, module) for name, module in sys.modules.items() if name.startswith("flowing_puppet_ros")]
    kernels = {f"{m}.{n}": f for m, module in loaded for n, f in vars(module).items() if isinstance(f, Dispatcher)}
    return {name: [str(one) for one in kernel.signatures] for name, kernel in kernels.items()}

factory = BagMessageFactory()
"""
RECORDING = """
from pathlib import Path
from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.image.video.settings import LiveDetectionSettings
from flowing_puppet_ros.model import weights
from flowing_puppet_ros.stream.components.optical_flow import OpticalFlowComponent
from flowing_puppet_ros.stream.components.puppet_tracker import PuppetTrackerComponent
from flowing_puppet_ros.stream.components.visual_hull import VisualHullComponent

OWN = LiveDetectionSettings(source="own")
components = {}
for name, kind, settings in (
    ("flow", OpticalFlowComponent, {}), ("told", PuppetTrackerComponent, {"detection": OWN}),
    ("cam1", PuppetTrackerComponent, {}), ("cam2", PuppetTrackerComponent, {}),
    ("hull", VisualHullComponent, {"cameras": "cam1,cam2", "hull_every": 1}), ("fitter", BodyFitterComponent, {}),
):
    component = components[name] = kind(kind.settings_type(**settings), factory)
    component.warm_up()
    for port in component.outputs:
        if port.lazy:
            component.set_subscribed(port.name, True)
traces = {name: dict(component.counters) for name, component in components.items()}
before = state()

def fail(*names):
    raise AssertionError(f"weights are loaded late: {names}")

weights.load = fail
components["told"].set_expected("detections", True)
for name in ("cam1", "cam2"):
    components[name].set_expected("detections", True)
with open_bag(Path("bags/golden/golden.mcap")) as bag:
    for record in bag.messages():
        topic, message = record.topic.removesuffix("/compressed"), record.message
        name, _, port = topic[1:].rpartition("/")
        if topic == "/tf_static":
            components["hull"].handle(topic, message)
        if name not in ("cam1", "cam2"):
            continue
        if port in ("image", "camera_info"):
            components["hull"].handle(f"{name}/{port}", message)
        if port in ("image", "detections"):
            for made, item in components[name].handle(port, message):
                if made in ("part_labels", "puppets"):
                    components["hull"].handle(f"{name}/{made}", item)
        if name == "cam1" and port == "image":
            components["flow"].handle(port, message)
            components["told"].set_expected("detections", False)  # its own detector looks
            components["told"].handle(port, message)
after = state()
late = {name: kinds for name, kinds in after.items() if kinds != before.get(name)}
done = {name: dict(component.counters) for name, component in components.items()}
print(json.dumps({"late": late, "known": sum(map(bool, before.values())), "traces": traces, "done": done}))
"""
SCANS = """
from benchmarks.scenes import draw_walk
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header

component = BodyFitterComponent(BodyFitterComponent.settings_type(), factory)
component.warm_up()
scans = draw_walk(StitchedPuppet.load(), 1, 3)
before = state()
for number, points in enumerate(scans, start=1):
    header = make_header(factory, number * 100_000_000, "lidar")
    component.handle("points", make_cloud(factory, header, points))
late = {name: kinds for name, kinds in state().items() if kinds != before.get(name)}
print(json.dumps({"late": late, "done": dict(component.counters)}))
"""


def run_script(script: str) -> Any:
    run = subprocess.run([sys.executable, "-c", KERNELS + script], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout.splitlines()[-1])


def test_the_first_messages_wait_for_nothing() -> None:
    told = run_script(RECORDING)
    assert told["late"] == {}
    assert told["known"] > 10
    assert not any(told["traces"].values())
    assert told["done"]["hull"]["hulls"] > 0 and told["done"]["hull"]["silhouettes"] > 0
    assert told["done"]["flow"]["flows"] == 7 and told["done"]["told"]["images"] == 8


def test_the_first_scans_of_a_lidar_wait_for_nothing() -> None:
    told = run_script(SCANS)
    assert told["late"] == {}
    assert told["done"]["tracked people"] > 0


def test_a_body_fitter_warms_up_by_tracking_somebody() -> None:
    factory = BagMessageFactory()
    component = BodyFitterComponent(BodyFitterSettings(), factory)
    warm_up.run(component, warm_up.make_fitter_input(factory, StitchedPuppet.load()))
    assert component.counters["clouds"] == warm_up.FRAMES
    assert component.counters["tracked people"] >= 2
    assert component.counters["unusable"] == 0
