# SPDX-License-Identifier: Apache-2.0
"""The same tasks done by what people use today, each in a virtual environment of its own that is made when asked for.

Peers are no part of the package and nothing of them is imported here: their scripts stand in `peers`, and speak JSON.
Times are processor seconds, so that what else the machine does disturbs little.
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

from flowing_puppet_ros.body.fit.fitter import BodyFitter, FitterSettings
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.evaluate.body.bodies import drawn_scans, scored_fit
from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource
from flowing_puppet_ros.evaluate.tables import Row
from flowing_puppet_ros.evaluate.video.errors import ClipErrors, TrackedPerson, clip_errors, summary
from flowing_puppet_ros.evaluate.video.methods import ClipRun, VideoSettings, run_method
from flowing_puppet_ros.evaluate.video.truth import find_clips, read_people
from flowing_puppet_ros.image.formats.video_reader import open_frames
from flowing_puppet_ros.learn.anny.body import AnnyBody
from flowing_puppet_ros.model import weights
from flowing_puppet_ros.model.sp import StitchedPuppet

SCRIPTS = Path(__file__).resolve().parent / "peers"
# Left behind by the ROS wheels' start-up hook; another environment's Python must not see them.
HIDDEN = ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "LD_LIBRARY_PATH", "PYTHONPATH")
PEER_POINTS = 2500  # of the cloud, for the gradients: more make them slower, not better
SHAPES, SHAPE_COUNT = 200, 10  # people, and components of their shapes, that the gradients may use
STEPS, EVERY = 1000, 20


@dataclass(frozen=True, slots=True)
class Peer:
    """A script and what it needs."""

    name: str
    script: str
    requirements: tuple[str, ...]

    def python(self, folder: Path) -> Path:
        """Return the Python of the peer's environment below `folder`, which is made if it is not there."""
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
        """Run the script and return what it prints, read as JSON; PuppetError with its last line when it fails."""
        return json.loads(_run([str(self.python(folder)), str(SCRIPTS / self.script), *arguments]).splitlines()[-1])


GRADIENT = Peer("gradient", "gradient_fit.py", ("jax", "scipy"))
MEDIAPIPE = Peer("mediapipe", "mediapipe_pose.py", ("mediapipe==0.10.21",))


def gradient(folder: Path, count: int, seed: int, mocap: Path | None) -> list[Row]:
    """Fits to whole scans of `count` people against gradient fitting of the Anny body with a chamfer loss.

    The gradients fit the very model that the people were drawn from, the puppet does not. Rows: mean vertex error of
    both, of the gradients at the puppet's time and at their end; the time that the gradients take to come as close.
    """
    fitter, source = BodyFitter(StitchedPuppet.load(), FitterSettings(threads=1)), BodySource(mocap)
    warm = True
    body, rows = gradient_body(seed), []
    for person, scene, cloud in drawn_scans("whole", source, count, seed):
        if warm:
            scored_fit(fitter, person, scene, cloud, source.joint_names)
            warm = False
        _, score = scored_fit(fitter, person, scene, cloud, source.joint_names)
        chosen = np.random.default_rng(seed).permutation(len(cloud.points))[:PEER_POINTS]
        truth = person.template_vertices(fitter.model.name)
        with tempfile.TemporaryDirectory() as place:
            path = Path(place) / "task.npz"
            task: dict[str, Any] = {**body, "cloud": cloud.points[chosen], "truth": truth}
            np.savez(path, **task)
            curve = np.array(GRADIENT.run(folder, str(path), str(STEPS), str(EVERY))["curve"])
        rows.append(gradient_row(score.vertex_error, score.seconds, curve))
    return rows


def gradient_row(error: float, seconds: float, curve: np.ndarray) -> Row:
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


def gradient_body(seed: int) -> dict[str, np.ndarray]:
    """The Anny body as arrays: rest vertices of the puppet's template and joints, linear in shape coefficients.

    The components are those of SHAPES random people, so that the gradients have as fine shapes as the puppet has.
    """
    anny, rng = AnnyBody("neutral"), np.random.default_rng(seed)
    chosen = weights.load("sp", "neutral")["anny_vertex"]
    people = [anny.rest(anny.sample_phenotype(rng)) for _ in range(SHAPES)]
    rows = np.array([np.concatenate([person.vertices[chosen], person.joints]).ravel() for person in people])
    mean = rows.mean(axis=0)
    _, values, axes = np.linalg.svd(rows - mean, full_matrices=False)
    basis = (axes[:SHAPE_COUNT] * values[:SHAPE_COUNT, None] / np.sqrt(SHAPES)).T.reshape(-1, 3, SHAPE_COUNT)
    split, mean = len(chosen), mean.reshape(-1, 3)
    return {
        "vertices": mean[:split],
        "vertex_basis": basis[:split],
        "joints": mean[split:],
        "joint_basis": basis[split:],
        "weights": anny.skin_weights[chosen],
        "parents": anny.bone_parents,
    }


def mediapipe(folder: Path, clips: Path, truth: Path, names: Sequence[str]) -> list[Row]:
    """Elbows and wrists of annotated clips by MediaPipe and by the tracker, live and over whole clips.

    MediaPipe's "full" model is the one whose weights are in its wheel.
    """
    places = find_clips(clips, names)
    people = read_people(truth, places)
    made = MEDIAPIPE.run(folder, *(str(places[name]) for name in people))
    errors = {
        name: clip_errors(_tracked(made["clips"][places[name].stem]), true, _size(places[name]))
        for name, true in people.items()
    }
    rows = [{"method": "MediaPipe full"} | _figures(errors, made["milliseconds_a_frame"])]
    for method in ("live", "default"):
        errors, spent, frames = {}, 0.0, 0
        for number, (name, true) in enumerate(people.items()):
            images = list(open_frames(places[name]))
            run = ClipRun.load(images, None, VideoSettings())
            if number == 0:
                run_method(method, ClipRun.load(images[:3], None, VideoSettings()))
            started = time.process_time()
            track = run_method(method, run)
            spent, frames = spent + time.process_time() - started, frames + len(images)
            found = {
                frame.index: [TrackedPerson.of(run.joint_names, one.joints, one.confidence) for one in seen]
                for frame, seen in zip(images, track, strict=True)
            }
            errors[name] = clip_errors(found, true, _size(places[name]))
        rows.append({"method": f"puppets, {method}"} | _figures(errors, 1000 * spent / frames))
    return rows


def _figures(errors: Mapping[str, ClipErrors], milliseconds: float) -> Row:
    return {"clips": len(errors)} | summary(errors) | {"milliseconds_a_frame": milliseconds}


def _tracked(data: Mapping[str, Any]) -> dict[int, list[TrackedPerson]]:
    found = {}
    for index, persons in data["frames"].items():
        rows = [np.array(person, np.float64) for person in persons]
        found[int(index)] = [TrackedPerson.of(data["joint_names"], row[:, :2], row[:, 2]) for row in rows]
    return found


def _size(clip: Path) -> tuple[int, int]:
    height, width = next(iter(open_frames(clip))).image.shape[:2]
    return width, height


def _run(command: list[str]) -> str:
    clean = {name: value for name, value in os.environ.items() if name not in HIDDEN}
    done = subprocess.run(command, env=clean, capture_output=True, text=True)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["it printed nothing"])[-1]
        raise PuppetError(f"{Path(command[0]).parent.parent.name}: {' '.join(command[1:3])} failed: {last}")
    return done.stdout
