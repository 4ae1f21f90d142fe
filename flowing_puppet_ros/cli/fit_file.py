# SPDX-License-Identifier: Apache-2.0
"""Fit one file for `flowing-puppet fit`: determine unit, axes and view, fit the body, write the result."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter, FitterSettings
from flowing_puppet_ros.body.fit.up_axis_search import fit_in_best_frame
from flowing_puppet_ros.body.scans.scan import Scan, read_scan, to_smallest_float, write_ply
from flowing_puppet_ros.body.scans.scan_frame import (
    UNITS,
    ScanFrame,
    guess_scale,
    is_seen_from_origin,
    parse_axis,
    propose_all_up_axes,
    propose_up_axes,
)
from flowing_puppet_ros.body.segmentation.people import SegmentationSettings
from flowing_puppet_ros.body.segmentation.up_axis import segment_people_unknown_up
from flowing_puppet_ros.cli.fit_scene import fit_one_sided_scene
from flowing_puppet_ros.draw.palette import part_colours
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.model.sp import StitchedPuppet

WRITTEN_SHAPE_COEFFICIENTS = 4  # of each part, as in the thesis; all are in `all_shape_coefficients`
MAX_SCENE_POINTS = 300_000  # sampled from a scene


@dataclass(frozen=True, slots=True, eq=False)
class ScanPerson:
    """One person's cloud in a scan's frame and unit.

    Attributes:
        suffix: appended to the input's stem for the result.
        points: (N, 3).
        normals: (N, 3) or None.
        scale: metres per unit.
        ups: directions (3,) that may be up, the most likely first.
        sensor: (3,) position of the sensor if the cloud shows one side, else None.
    """

    suffix: str
    points: np.ndarray
    normals: np.ndarray | None
    scale: float
    ups: list[np.ndarray]
    sensor: np.ndarray | None


@dataclass(frozen=True, slots=True)
class FitOptions:
    """All options of a fit; see the flags of `fit`. Only `settings.threads` does not change the result."""

    out: Path = field(repr=False)
    model: str
    up: str
    upright: str
    unit: str
    view: str
    scene: bool
    settings: FitterSettings
    segmentation: SegmentationSettings


def fit_file(source: Path, options: FitOptions, shown: bool = False) -> dict[str, Any]:
    """Fit the person, or the people of a scene, in one file; write the results and return a summary for JSON.

    `shown` draws a progress bar on stderr. PuppetError if the file cannot be used or shows no person.
    """
    started = time.perf_counter()
    fitter = _make_fitter(options.model, options.settings)
    _refuse_overwriting(source, options)
    scan = read_scan(source)
    if not options.scene:
        person = _take_whole_scan(scan, fitter, options)
        return {"input": str(source)} | _fit_person(source, person, fitter, options, started, shown)
    fits = []
    found = _find_one_sided(scan, fitter, options)
    for number, fit in enumerate(found[1] if found else [], start=1):
        assert found is not None
        output = options.out / f"{source.stem}-{number}.npz"
        seconds = (time.perf_counter() - started) / len(found[1])  # found together
        fits.append(_finish(output, fitter.model, found[0], fit, "single", seconds))
    if fits:
        return {"input": str(source), "people": fits}
    for person in _segment_scene(scan, source, fitter, options):
        fits.append(_fit_person(source, person, fitter, options, started, shown))
        started = time.perf_counter()
    return {"input": str(source), "people": fits}


def list_files(summary: dict[str, Any]) -> list[Path]:
    """List the files that a summary of `fit_file` names."""
    outputs = [Path(fit["output"]) for fit in summary.get("people", [summary])]
    return [output.with_suffix(suffix) for output in outputs for suffix in (".npz", ".ply")]


@lru_cache(maxsize=1)
def _make_fitter(model: str, settings: FitterSettings) -> BodyFitter:
    """Make the fitter that all inputs of a process share."""
    return BodyFitter(StitchedPuppet.load(model), settings)


def _refuse_overwriting(source: Path, options: FitOptions) -> None:
    if not options.scene and source.suffix in (".npz", ".ply") and source.parent.resolve() == options.out.resolve():
        raise InputError(f"the fit of {source} would overwrite it; choose another folder for --out")


def _take_whole_scan(scan: Scan, fitter: BodyFitter, options: FitOptions) -> ScanPerson:
    """Return the only person of a scan."""
    scale = guess_scale(scan) if options.unit == "auto" else UNITS[options.unit]
    points, normals = scan.sample_surface(fitter.settings.max_points, np.random.default_rng(fitter.settings.seed))
    sensor = _locate_sensor(points, normals, scale, options.view)
    ups = propose_up_axes(points, sensor is not None) if options.up == "auto" else [parse_axis(options.up)]
    return ScanPerson("", points, normals, scale, _candidate_ups(points, ups, options), sensor)


def _find_one_sided(scan: Scan, fitter: BodyFitter, options: FitOptions) -> tuple[ScanFrame, list[BodyFit]] | None:
    """Return the people of a scene that was seen from the origin, None where it was not, or nobody is found so."""
    if options.upright == "any" or scan.faces is not None:
        return None
    scale = UNITS["m" if options.unit == "auto" else options.unit]
    ups = [parse_axis(name) for name in (("z", "y", "-y") if options.up == "auto" else (options.up,))]
    return fit_one_sided_scene(fitter, scan.points, scale, ups, options.view, options.segmentation)


def _segment_scene(scan: Scan, path: Path, fitter: BodyFitter, options: FitOptions) -> list[ScanPerson]:
    """Segment the people in the cloud of a scene; PuppetError if there is none."""
    scale = UNITS["m" if options.unit == "auto" else options.unit]
    points, normals = scan.sample_surface(MAX_SCENE_POINTS, np.random.default_rng(fitter.settings.seed))
    ups = [parse_axis(name) for name in (("z", "y", "-y") if options.up == "auto" else (options.up,))]
    sensor = None if options.view == "full" else np.zeros(3)
    up, found = segment_people_unknown_up(points, normals, scale, ups, sensor, options.segmentation)
    if not found:
        raise PuppetError(
            f"{path} shows no person among its {len(points)} points; check --up and --unit, lower "
            "--segmentation-min-score, or cut the person out and leave --scene"
        )
    people = []
    for number, cloud in enumerate(found, start=1):
        seen = _locate_sensor(cloud.points, cloud.normals, scale, options.view)
        ways = _candidate_ups(cloud.points, [up], options)
        people.append(ScanPerson(f"-{number}", cloud.points, cloud.normals, scale, ways, seen))
    return people


def _candidate_ups(points: np.ndarray, ups: list[np.ndarray], options: FitOptions) -> list[np.ndarray]:
    return propose_all_up_axes(points) if options.upright == "any" else ups


def _fit_person(
    path: Path, person: ScanPerson, fitter: BodyFitter, options: FitOptions, started: float, shown: bool
) -> dict[str, Any]:
    output = options.out / f"{path.stem}{person.suffix}.npz"
    with tqdm(total=100, desc=output.stem, unit="%", file=sys.stderr, disable=not shown) as bar:
        frame, fit = fit_in_best_frame(
            fitter,
            person.points,
            person.normals,
            scale=person.scale,
            ups=person.ups,
            sensor=person.sensor,
            progress=_progress_on(bar),
        )
    view = "full" if person.sensor is None else "single"
    return _finish(output, fitter.model, frame, fit, view, time.perf_counter() - started)


def _finish(
    output: Path, model: StitchedPuppet, frame: ScanFrame, fit: BodyFit, view: str, seconds: float
) -> dict[str, Any]:
    """Write a fit and return its summary."""
    try:
        _write_fit(output, model, frame, fit, seconds)
    except OSError as error:
        raise PuppetError(f"{output} cannot be written: {error.strerror}") from error
    return {
        "output": str(output),
        "model": model.name,
        "energy": fit.energy,
        "confidence": fit.confidence,
        "reliable": fit.reliable,
        "two_way_distance_m": fit.two_way_distance,
        "metres_per_unit": frame.scale,
        "up": np.round(frame.up, 6).tolist(),
        "view": view,
        "seconds": seconds,
    }


def _progress_on(bar: tqdm) -> Callable[[float], None]:
    return lambda done: bar.update(int(100 * done) - bar.n) and None


def _locate_sensor(points: np.ndarray, normals: np.ndarray | None, scale: float, view: str) -> np.ndarray | None:
    """Return the position (3,) of the sensor of a cloud from one side, None for a cloud from all sides.

    It is the origin if that lies outside the cloud, otherwise in the mean direction of the normals.
    """
    if view == "full" or (view == "auto" and not is_seen_from_origin(scale * points)):
        return None
    low, high = points.min(axis=0), points.max(axis=0)
    if np.any((low > 0) | (high < 0)):
        return np.zeros(3)
    if normals is None:
        raise InputError("--view single needs the sensor at the origin of the input's frame, or normals; give either")
    mean = normals.mean(axis=0)
    return points.mean(axis=0) + 3 * float(np.ptp(points, axis=0).max()) * mean / max(float(np.linalg.norm(mean)), 1e-9)


def _write_fit(output: Path, model: StitchedPuppet, frame: ScanFrame, fit: BodyFit, seconds: float) -> None:
    """Write the fit, in the scan's frame and unit, as `output` and as a mesh beside it."""
    vertices = to_smallest_float(frame.to_scan(fit.vertices))
    arrays: dict[str, Any] = {
        "vertices": vertices,
        "faces": model.faces,
        "part_of_vertex": model.part_of_vertex,
        "part_names": np.array(model.tree.names),
        "part_rotation": (frame.rotation.T @ fit.state.rotation).astype(np.float32),
        "part_center": frame.to_scan(fit.state.center).astype(vertices.dtype),
        "part_confidence": fit.part_confidence.astype(np.float32),
        "joint_names": np.array(model.joint_names),
        "joints": frame.to_scan(fit.joints).astype(vertices.dtype),
        "shape_coefficients": fit.state.shape[:, :WRITTEN_SHAPE_COEFFICIENTS].astype(np.float32),
        "all_shape_coefficients": fit.state.shape.astype(np.float32),
        "pose_coefficients": fit.state.pose.astype(np.float32),
        "energy": fit.energy,
        "confidence": fit.confidence,
        "reliable": fit.reliable,
        "two_way_distance": fit.two_way_distance / frame.scale,
        "seconds": seconds,
        "model": model.name,
    }
    # Write atomically, in case two machines make the same result or one is stopped.
    unfinished = output.with_name(f".{output.stem}.{os.getpid()}")
    try:
        with unfinished.open("wb") as stream:
            np.savez_compressed(stream, **arrays)
        unfinished.replace(output)
        colours = part_colours(model.tree.names)[model.part_of_vertex]
        write_ply(unfinished, vertices, model.faces, colours)
        unfinished.replace(output.with_suffix(".ply"))
    finally:
        unfinished.unlink(missing_ok=True)
