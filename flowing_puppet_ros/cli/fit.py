# SPDX-License-Identifier: Apache-2.0
"""Fit the 3D Stitched Puppet to meshes and clouds of one person each, or to the people in clouds of scenes."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from flowing_puppet_ros.body.fitter import BodyFit, BodyFitter, FitterSettings
from flowing_puppet_ros.body.frames import (
    UNITS,
    UP_NAMES,
    Frame,
    all_candidates,
    axis_of,
    guess_scale,
    seen_from_origin,
    up_candidates,
)
from flowing_puppet_ros.body.io import Scan, read_scan, storable, write_ply
from flowing_puppet_ros.body.people import ExtractionSettings
from flowing_puppet_ros.body.scene import people_of_scene
from flowing_puppet_ros.body.upright import fit_in_best_frame
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.settings import make_out_folder
from flowing_puppet_ros.view.palette import part_colours

WRITTEN_SHAPES = 4
SCENE_POINTS = 300_000


@dataclass(frozen=True, slots=True, eq=False)
class Person:
    """One person's cloud in a scan's frame and unit.

    Attributes:
        suffix: appended to the input's stem for the result.
        points: (N, 3).
        normals: (N, 3) or None.
        scale: metres a unit.
        ups: directions (3,) that may be up, the likelier first.
        sensor: (3,) where the sensor stood if the cloud shows one side.
    """

    suffix: str
    points: np.ndarray
    normals: np.ndarray | None
    scale: float
    ups: list[np.ndarray]
    sensor: np.ndarray | None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("inputs", nargs="+", type=Path, metavar="INPUT", help=".ply .obj .off .stl .pcd .xyz .npy .npz")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for <stem>.npz and <stem>.ply")
    parser.add_argument(
        "--model", choices=("neutral", "female", "male"), default="neutral", help="body model [neutral]"
    )
    FitterSettings.add_arguments(parser)
    parser.add_argument(
        "--up",
        choices=(*UP_NAMES, "auto"),
        default="auto",
        help="the axis of the input's frame that points up; --up=-y in optical frames [auto]",
    )
    parser.add_argument(
        "--upright",
        choices=("yes", "any"),
        default="yes",
        help="whether people are upright along --up, or may lie or hang in any direction, whatever --up says [yes]",
    )
    parser.add_argument("--unit", choices=(*UNITS, "auto"), default="auto", help="the input's unit [auto]")
    parser.add_argument(
        "--view",
        choices=("full", "single", "auto"),
        default="auto",
        help="whether the input shows all sides, or one, seen from the origin of its frame [auto]",
    )
    parser.add_argument(
        "--scene",
        action="store_true",
        help="find the people among floor, walls and furniture first (in metres if --unit is auto); results are"
        " <stem>-1 and so on, the likeliest person first",
    )
    ExtractionSettings.add_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object per input on stdout")


def run(arguments: argparse.Namespace) -> int:
    """Fit every input; one that fails is reported and the others go on."""
    stems = Counter(path.stem for path in arguments.inputs)
    double = next((stem for stem, count in stems.items() if count > 1), None)
    if double is not None:
        raise InputError(f"two inputs are called {double!r} and would overwrite each other's result; fit them apart")
    extraction = ExtractionSettings.from_arguments(arguments)
    fitter = BodyFitter(StitchedPuppet.load(arguments.model), FitterSettings.from_arguments(arguments))
    make_out_folder(arguments.out)
    status = 0
    for path in arguments.inputs:
        try:
            summary = _fit_file(path, fitter, extraction, arguments)
        except PuppetError as error:
            print(f"flowing-puppet fit: {error}", file=sys.stderr)
            summary = {"input": str(path), "error": str(error)}
            status = max(status, error.exit_status)
        if arguments.json:
            print(json.dumps(summary), flush=True)
    return status


def _fit_file(
    path: Path, fitter: BodyFitter, extraction: ExtractionSettings, arguments: argparse.Namespace
) -> dict[str, object]:
    started = time.perf_counter()
    scan = read_scan(path)
    if not arguments.scene:
        return {"input": str(path)} | _fit_person(
            path, _whole_scan(scan, fitter, arguments), fitter, arguments, started
        )
    fits = []
    for person in _people(scan, path, fitter, extraction, arguments):
        fits.append(_fit_person(path, person, fitter, arguments, started))
        started = time.perf_counter()
    return {"input": str(path), "people": fits}


def _whole_scan(scan: Scan, fitter: BodyFitter, arguments: argparse.Namespace) -> Person:
    """The only person of a scan."""
    scale = guess_scale(scan) if arguments.unit == "auto" else UNITS[arguments.unit]
    points, normals = scan.surface(fitter.settings.cloud_points, np.random.default_rng(fitter.settings.seed))
    sensor = _sensor(points, normals, scale, arguments.view)
    ups = up_candidates(points, sensor is not None) if arguments.up == "auto" else [axis_of(arguments.up)]
    return Person("", points, normals, scale, _any_way(points, ups, arguments), sensor)


def _people(
    scan: Scan, path: Path, fitter: BodyFitter, extraction: ExtractionSettings, arguments: argparse.Namespace
) -> list[Person]:
    """The people in the cloud of a scene."""
    scale = UNITS["m" if arguments.unit == "auto" else arguments.unit]
    points, normals = scan.surface(SCENE_POINTS, np.random.default_rng(fitter.settings.seed))
    ups = [axis_of(name) for name in (("z", "y", "-y") if arguments.up == "auto" else (arguments.up,))]
    sensor = None if arguments.view == "full" else np.zeros(3)
    up, found = people_of_scene(points, normals, scale, ups, sensor, extraction)
    if not found:
        raise PuppetError(
            f"{path} shows nobody among its {len(points)} points; check --up and --unit, lower --likeness, or cut the"
            " person out and leave --scene"
        )
    people = []
    for number, cloud in enumerate(found, start=1):
        seen = _sensor(cloud.points, cloud.normals, scale, arguments.view)
        ways = _any_way(cloud.points, [up], arguments)
        people.append(Person(f"-{number}", cloud.points, cloud.normals, scale, ways, seen))
    return people


def _any_way(points: np.ndarray, ups: list[np.ndarray], arguments: argparse.Namespace) -> list[np.ndarray]:
    return all_candidates(points) if arguments.upright == "any" else ups


def _fit_person(
    path: Path, person: Person, fitter: BodyFitter, arguments: argparse.Namespace, started: float
) -> dict[str, object]:
    output = arguments.out / f"{path.stem}{person.suffix}.npz"
    with tqdm(total=100, desc=output.stem, unit="%", file=sys.stderr, leave=not arguments.json) as bar:
        frame, fit = fit_in_best_frame(
            fitter,
            person.points,
            person.normals,
            scale=person.scale,
            ups=person.ups,
            sensor=person.sensor,
            progress=_shown(bar),
        )
    seconds = time.perf_counter() - started
    try:
        _write(output, fitter.model, frame, fit, seconds)
    except OSError as error:
        raise PuppetError(f"{output} cannot be written: {error.strerror}") from error
    if not fit.reliable:
        print(f"flowing-puppet fit: {output} is not reliable: a limb may be wrong, or it is no person", file=sys.stderr)
    return {
        "output": str(output),
        "model": fitter.model.name,
        "energy": fit.energy,
        "confidence": fit.confidence,
        "reliable": fit.reliable,
        "two_way_distance_m": fit.two_way_distance,
        "metres_per_unit": frame.scale,
        "up": np.round(frame.up, 6).tolist(),
        "view": "full" if person.sensor is None else "single",
        "seconds": seconds,
    }


def _shown(bar: tqdm) -> Callable[[float], None]:
    return lambda done: bar.update(int(100 * done) - bar.n) and None


def _sensor(points: np.ndarray, normals: np.ndarray | None, scale: float, view: str) -> np.ndarray | None:
    """Where the sensor of a cloud from one side stood, None for one from all sides.

    It stood at the origin when that lies outside the cloud, otherwise where the normals look.
    """
    if view == "full" or (view == "auto" and not seen_from_origin(scale * points)):
        return None
    low, high = points.min(axis=0), points.max(axis=0)
    if np.any((low > 0) | (high < 0)):
        return np.zeros(3)
    if normals is None:
        raise InputError("--view single needs the sensor at the origin of the input's frame, or normals; give either")
    mean = normals.mean(axis=0)
    return points.mean(axis=0) + 3 * float(np.ptp(points, axis=0).max()) * mean / max(float(np.linalg.norm(mean)), 1e-9)


def _write(output: Path, model: StitchedPuppet, frame: Frame, fit: BodyFit, seconds: float) -> None:
    """Write the fit in the scan's frame and unit as `output` and as a mesh beside it."""
    vertices = storable(frame.to_scan(fit.vertices))
    np.savez_compressed(
        output,
        vertices=vertices,
        faces=model.faces,
        part_of_vertex=model.part_of_vertex,
        part_names=np.array(model.tree.names),
        part_rotation=(frame.rotation.T @ fit.state.rotation).astype(np.float32),
        part_center=frame.to_scan(fit.state.center).astype(vertices.dtype),
        part_confidence=fit.part_confidence.astype(np.float32),
        joint_names=np.array(model.joint_names),
        joints=frame.to_scan(fit.joints).astype(vertices.dtype),
        shape_coefficients=fit.state.shape[:, :WRITTEN_SHAPES].astype(np.float32),
        all_shape_coefficients=fit.state.shape.astype(np.float32),
        pose_coefficients=fit.state.pose.astype(np.float32),
        energy=fit.energy,
        confidence=fit.confidence,
        reliable=fit.reliable,
        two_way_distance=fit.two_way_distance / frame.scale,
        seconds=seconds,
        model=model.name,
    )
    write_ply(
        output.with_name(f"{output.stem}.ply"),
        vertices,
        model.faces,
        part_colours(model.tree.names)[model.part_of_vertex],
    )
