# SPDX-License-Identifier: Apache-2.0
"""The same tasks done by common alternatives, each in a virtual environment of its own that is made on demand.

Peers are not part of the package and are not imported here: their scripts are in `peers` and print JSON. Times are
processor seconds, which other programs on the machine disturb little.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.evaluate.body.bodies import draw_scans, score_fit
from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource
from flowing_puppet_ros.evaluate.tables import Row
from flowing_puppet_ros.evaluate.video.errors import ClipErrors, TrackedPerson, measure_clip, summarise
from flowing_puppet_ros.evaluate.video.methods import ClipRun, run_method
from flowing_puppet_ros.evaluate.video.truth import find_clips, read_people
from flowing_puppet_ros.image.formats.video_reader import open_frames
from flowing_puppet_ros.image.video.settings import ClipSettings
from flowing_puppet_ros.learn.anny.body import AnnyBody
from flowing_puppet_ros.model import weights
from flowing_puppet_ros.model.sp import StitchedPuppet

SCRIPTS = Path(__file__).resolve().parent / "peers"
# Set by the ROS wheels' start-up hook; the Python of another environment must not inherit them.
HIDDEN_VARIABLES = ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "LD_LIBRARY_PATH", "PYTHONPATH")
PEER_POINTS = 2500  # of the cloud, for the gradient fit: more points make it slower, not better
SHAPE_SAMPLES, SHAPE_COMPONENTS = 200, 10  # people, and principal components of their shapes, of the gradient fit
GRADIENT_STEPS, STEPS_PER_RECORD = 1000, 20  # of the gradient fit, and of its curve


@dataclass(frozen=True, slots=True)
class Peer:
    """A script and its requirements."""

    name: str
    script: str
    requirements: tuple[str, ...]

    def ensure_python(self, folder: Path) -> Path:
        """Return the Python of the peer's environment below `folder`, which is made if missing."""
        if not (SCRIPTS / self.script).is_file():
            raise InputError(f"bench peers needs the source tree: {SCRIPTS / self.script} is not there")
        home = folder / self.name
        python, done = home / "bin" / "python", home / "installed"
        if not done.is_file() or done.read_text() != str(self.requirements):
            print(f"making {home} with {', '.join(self.requirements)}", file=sys.stderr)
            _run([sys.executable, "-m", "venv", str(home)])
            _run([str(python), "-m", "pip", "install", "--quiet", *self.requirements])
            done.write_text(str(self.requirements))
        return python

    def run(self, folder: Path, *arguments: str) -> Any:
        """Run the script and return its output parsed as JSON; PuppetError with its last line if it fails."""
        return json.loads(
            _run([str(self.ensure_python(folder)), str(SCRIPTS / self.script), *arguments]).splitlines()[-1]
        )


GRADIENT = Peer("gradient", "gradient_fit.py", ("jax", "scipy"))
MEDIAPIPE = Peer("mediapipe", "mediapipe_pose.py", ("mediapipe==0.10.21",))


def compare_gradient(folder: Path, count: int, seed: int, mocap: Path | None) -> list[Row]:
    """Compare fits to whole scans of `count` people with gradient fitting of the Anny body with a chamfer loss.

    The gradient fit uses the model that the people were drawn from; the puppet does not. Rows have the mean vertex
    error of both, that of the gradient fit at the puppet's time and at its end, and its time to reach the puppet's.
    """
    fitter, source = BodyFitter(StitchedPuppet.load(), FitterSettings(threads=1)), BodySource(mocap)
    warm = True
    body, rows = export_body(seed), []
    for person, scene, cloud in draw_scans("whole", source, count, seed):
        if warm:
            score_fit(fitter, person, scene, cloud, source.joint_names)
            warm = False
        _, score = score_fit(fitter, person, scene, cloud, source.joint_names)
        chosen = np.random.default_rng(seed).permutation(len(cloud.points))[:PEER_POINTS]
        truth = person.template_vertices(fitter.model.name)
        with tempfile.TemporaryDirectory() as place:
            path = Path(place) / "task.npz"
            task: dict[str, Any] = {**body, "cloud": cloud.points[chosen], "truth": truth}
            np.savez(path, **task)
            curve = np.array(GRADIENT.run(folder, str(path), str(GRADIENT_STEPS), str(STEPS_PER_RECORD))["curve"])
        rows.append(compare_curve(score.vertex_error, score.seconds, curve))
    return rows


def compare_curve(error: float, seconds: float, curve: np.ndarray) -> Row:
    """Compare a fit (metres, seconds) with a `curve` (n, 2 or more) of seconds and errors."""
    then = curve[curve[:, 0] <= seconds]
    as_good = curve[curve[:, 1] <= error]
    return {
        "puppet_cm": 100 * error,
        "puppet_seconds": seconds,
        "gradient_cm_then": 100 * float(then[-1, 1]) if len(then) else float("nan"),
        "gradient_cm_end": 100 * float(curve[-1, 1]),
        "gradient_seconds": float(curve[-1, 0]),
        "gradient_seconds_as_good": float(as_good[0, 0]) if len(as_good) else float("inf"),
    }


def export_body(seed: int) -> dict[str, np.ndarray]:
    """Return the Anny body as arrays: rest vertices of the puppet's template and joints, linear in shape coefficients.

    The components are those of SHAPE_SAMPLES random people, so that its shapes are as fine as the puppet's.
    """
    anny, rng = AnnyBody("neutral"), np.random.default_rng(seed)
    chosen = weights.load("sp", "neutral")["anny_vertex"]
    people = [anny.make_rest_body(anny.sample_phenotype(rng)) for _ in range(SHAPE_SAMPLES)]
    rows = np.array([np.concatenate([person.vertices[chosen], person.joints]).ravel() for person in people])
    mean = rows.mean(axis=0)
    _, values, axes = np.linalg.svd(rows - mean, full_matrices=False)
    basis = (axes[:SHAPE_COMPONENTS] * values[:SHAPE_COMPONENTS, None] / np.sqrt(SHAPE_SAMPLES)).T.reshape(
        -1, 3, SHAPE_COMPONENTS
    )
    split, mean = len(chosen), mean.reshape(-1, 3)
    return {
        "vertices": mean[:split],
        "vertex_basis": basis[:split],
        "joints": mean[split:],
        "joint_basis": basis[split:],
        "weights": anny.skin_weights[chosen],
        "parents": anny.bone_parents,
    }


def compare_mediapipe(folder: Path, clips: Path, truth: Path, names: Sequence[str]) -> list[Row]:
    """Compare elbows and wrists of annotated clips by MediaPipe and by the tracker, live and over whole clips.

    MediaPipe's "full" model is the one with weights in its wheel.
    """
    places = find_clips(clips, names)
    people = read_people(truth, places)
    made = MEDIAPIPE.run(folder, *(str(places[name]) for name in people))
    errors = {
        name: measure_clip(_read_track(made["clips"][places[name].stem]), true, _image_size(places[name]))
        for name, true in people.items()
    }
    rows = [{"method": "MediaPipe full"} | _make_row(errors, made["milliseconds_a_frame"])]
    for method in ("live", "default"):
        errors, spent, frames = {}, 0.0, 0
        for number, (name, true) in enumerate(people.items()):
            images = list(open_frames(places[name]))
            run = ClipRun.load(images, None, ClipSettings())
            if number == 0:
                run_method(method, ClipRun.load(images[:3], None, ClipSettings()))
            started = time.process_time()
            track = run_method(method, run)
            spent, frames = spent + time.process_time() - started, frames + len(images)
            found = {
                frame.index: [TrackedPerson.of(run.joint_names, one.joints, one.confidence) for one in seen]
                for frame, seen in zip(images, track, strict=True)
            }
            errors[name] = measure_clip(found, true, _image_size(places[name]))
        rows.append({"method": f"puppets, {method}"} | _make_row(errors, 1000 * spent / frames))
    return rows


def _make_row(errors: Mapping[str, ClipErrors], milliseconds: float) -> Row:
    return {"clips": len(errors)} | summarise(errors) | {"milliseconds_a_frame": milliseconds}


def _read_track(data: Mapping[str, Any]) -> dict[int, list[TrackedPerson]]:
    found = {}
    for index, persons in data["frames"].items():
        rows = [np.array(person, np.float64) for person in persons]
        found[int(index)] = [TrackedPerson.of(data["joint_names"], row[:, :2], row[:, 2]) for row in rows]
    return found


def _image_size(clip: Path) -> tuple[int, int]:
    height, width = next(iter(open_frames(clip))).image.shape[:2]
    return width, height


def _run(command: list[str]) -> str:
    clean = {name: value for name, value in os.environ.items() if name not in HIDDEN_VARIABLES}
    done = subprocess.run(command, env=clean, capture_output=True, text=True)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["it printed nothing"])[-1]
        raise PuppetError(f"{Path(command[0]).parent.parent.name}: {' '.join(command[1:3])} failed: {last}")
    return done.stdout
