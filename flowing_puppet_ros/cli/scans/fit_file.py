# SPDX-License-Identifier: Apache-2.0
"""Fit one file for `flowing-puppet fit`: determine unit, axes and view, fit the body, write the result."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from flowing_puppet_ros.body.fit.fitter import BodyFitter, Progress
from flowing_puppet_ros.body.fit.up_axis_search import FrameFit, fit_in_best_frame, measure_stature
from flowing_puppet_ros.body.measurements.measure import DEFINITIONS, measure_fit
from flowing_puppet_ros.body.refine.body_beneath import measure_gaps, measure_part_gaps
from flowing_puppet_ros.body.scans.names import SUFFIXES
from flowing_puppet_ros.body.scans.scan import Scan, read_scan, to_smallest_float, write_ply
from flowing_puppet_ros.body.scans.unit import GUESS, ScanUnit, has_size_of_person
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.cli.scans.fit_people import FitOptions, ScanPerson, find_people, list_scene_ups
from flowing_puppet_ros.cli.scans.given_joints import fit_from_joints
from flowing_puppet_ros.draw.palette import part_colours
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.model.sp import StitchedPuppet

MIN_WORN_M = 0.008  # mean distance between surface and body from which on garments are told of
WRITTEN_SHAPE_COEFFICIENTS = 4  # of each part, as in the thesis; all are in `all_shape_coefficients`


def fit_file(source: Path, options: FitOptions, shown: bool = False) -> dict[str, Any]:
    """Fit the person, or the people of a scene, in one file; write the results and return a summary for JSON.

    `shown` draws a progress bar on stderr. PuppetError if the file cannot be used or shows no person.
    """
    started = time.perf_counter()
    fitter = make_fitter(options.model, options.settings)
    refuse_overwriting(source, options)
    viewed = _fit_view(source, fitter, options)
    if viewed is not None:
        return {"input": str(source), "people": _finish_all(source, *viewed, fitter, options, started)}
    scan = read_scan(source)
    seen, notes = _find_one_sided(scan, fitter, options) if options.scene else ([], ())
    if seen:
        return {"input": str(source), "people": _finish_all(source, seen, notes, fitter, options, started)}
    people = find_people(scan, source, fitter, options)
    if options.joints and len(people) > 1:
        raise InputError(f"{source} shows {len(people)} people and --joints are those of one; cut out one person")
    if not people[0].suffix:
        return {"input": str(source)} | _fit_person(source, people[0], fitter, options, started, shown)
    fits = []
    for person in people:
        fits.append(_fit_person(source, person, fitter, options, started, shown))
        started = time.perf_counter()
    return {"input": str(source), "people": fits}


def list_files(summary: dict[str, Any]) -> list[Path]:
    """List the files that a summary of `fit_file` names."""
    outputs = [Path(fit["output"]) for fit in summary.get("people", [summary])]
    return [output.with_suffix(suffix) for output in outputs for suffix in (".npz", ".ply")]


@lru_cache(maxsize=1)
def make_fitter(model: str, settings: FitterSettings) -> BodyFitter:
    """Make the fitter that all inputs of a process share."""
    return BodyFitter(StitchedPuppet.load(model), settings)


def refuse_overwriting(source: Path, options: FitOptions) -> None:
    """Raise InputError when a result would have the name of its input."""
    if (
        not options.scene
        and options.camera_info is None
        and source.suffix in (".npz", ".ply")
        and source.parent.resolve() == options.out.resolve()
    ):
        raise InputError(f"the fit of {source} would overwrite it; choose another folder for --out")


def fit_scan_person(person: ScanPerson, fitter: BodyFitter, options: FitOptions, progress: Progress) -> FrameFit:
    """Fit a person of a scan, from given joints or by a search. InputError when it cannot be a person."""
    if options.joints:
        return fit_from_joints(person, dict(options.joints), fitter, options)
    found = fit_in_best_frame(
        fitter,
        person.points,
        person.normals,
        units=person.units,
        ups=person.ups,
        sensor=person.sensor,
        progress=progress,
    )
    _refuse_no_person(person, found)
    return found


def _fit_person(
    path: Path, person: ScanPerson, fitter: BodyFitter, options: FitOptions, started: float, shown: bool
) -> dict[str, Any]:
    stem = f"{path.stem}{person.suffix}"
    with tqdm(total=100, desc=stem, unit="%", file=sys.stderr, disable=not shown or bool(options.joints)) as bar:
        found = fit_scan_person(person, fitter, options, _progress_on(bar))
    view = "full" if person.sensor is None else "single"
    return write_result(stem, fitter.model, found, view, person.notes, time.perf_counter() - started, options)


def _fit_view(source: Path, fitter: BodyFitter, options: FitOptions) -> tuple[list[FrameFit], tuple[str, ...]] | None:
    """Return the bodies in a depth image or an organised cloud and notes; None where it is to be read as a scan."""
    plain = options.camera_info is None and options.color is None and not options.scene
    if plain and source.suffix.lower() in SUFFIXES:
        return None
    from flowing_puppet_ros.cli.scans.fit_depth import fit_view, read_view  # loaded here: takes 0.15 s

    view = read_view(source, options)
    return None if view is None else fit_view(view, source, fitter, options)


def _find_one_sided(scan: Scan, fitter: BodyFitter, options: FitOptions) -> tuple[list[FrameFit], tuple[str, ...]]:
    """Return the people of a scene that was seen from the origin, and notes; none where it was not, or nobody is."""
    moved = options.viewpoint is not None or (scan.viewpoint is not None and np.any(scan.viewpoint))
    if options.upright == "any" or scan.faces is not None or moved:
        return [], ()
    from flowing_puppet_ros.cli.scans.fit_scene import fit_one_sided_scene  # loaded here: takes 0.1 s

    unit = ScanUnit.named("m" if options.unit == "auto" else options.unit)
    ups = list_scene_ups(options)
    found = fit_one_sided_scene(fitter, scan.points, unit.metres, ups, options.view, options.segmentation)
    if found is None:
        return [], ()
    measured = [(fit, measure_stature(fitter.model, fit.joints)) for fit in found.fits]
    return [FrameFit(found.frame, unit, fit, True, True, stature) for fit, stature in measured], found.notes


def write_result(
    stem: str,
    model: StitchedPuppet,
    found: FrameFit,
    view: str,
    notes: tuple[str, ...],
    seconds: float,
    options: FitOptions,
) -> dict[str, Any]:
    """Write a fit and return its summary."""
    output = options.out / f"{stem}.npz"
    measured = _measure(model, found) if options.measure else {}
    gap = _measure_gap(model, found)
    try:
        _write_fit(output, model, found, seconds, measured)
    except OSError as error:
        raise PuppetError(f"{output} cannot be written: {error.strerror}") from error
    fit, unit = found.fit, found.unit
    return {
        "output": str(output),
        "model": model.name,
        "energy": fit.energy,
        "confidence": fit.confidence,
        "reliable": fit.reliable,
        "two_way_distance_m": fit.two_way_distance * unit.metres / unit.fitted,
        "surface_to_body_m": gap,
        "unit": unit.name,
        "metres_per_unit": unit.metres,
        "unit_clear": found.unit_clear,
        "child": found.is_child,
        "up": np.round(found.frame.up, 6).tolist(),
        "up_clear": found.up_clear,
        "view": view,
        "notes": [*notes, *_describe_frame(found), *_describe_garments(gap)],
        **({"measurements": measured} if measured else {}),
        "seconds": seconds,
    }


def _finish_all(
    source: Path,
    seen: Sequence[FrameFit],
    notes: tuple[str, ...],
    fitter: BodyFitter,
    options: FitOptions,
    started: float,
) -> list[dict[str, Any]]:
    """Write the fits of people who were found together from one side, and return their summaries."""
    each = (time.perf_counter() - started) / len(seen)
    return [
        write_result(f"{source.stem}-{number}", fitter.model, found, "single", notes, each, options)
        for number, found in enumerate(seen, start=1)
    ]


def _measure(model: StitchedPuppet, found: FrameFit) -> dict[str, float]:
    """Return the measurements of a person in the unit of the scan's metres: a child was fitted as an adult."""
    shrink = found.unit.metres / found.unit.fitted
    measured = measure_fit(model, found.fit.state, _choose_skin(model, found))
    return {name: value * shrink ** DEFINITIONS[name].dimension for name, value in measured.items()}


def _measure_gap(model: StitchedPuppet, found: FrameFit) -> float:
    """Return the mean distance between surface and body over all vertices, metres of the scan."""
    gaps = measure_gaps(model, model.vertices(found.fit.state), found.fit.vertices)
    return float(np.abs(gaps).mean()) * found.unit.metres / found.unit.fitted


def _choose_skin(model: StitchedPuppet, found: FrameFit) -> np.ndarray:
    """Return what is measured (V, 3): the surface, or the body beneath where much is worn."""
    body = model.vertices(found.fit.state)
    worn = np.abs(measure_gaps(model, body, found.fit.vertices)).mean() > MIN_WORN_M
    return body if worn else found.fit.vertices


def _describe_garments(gap: float) -> list[str]:
    """Return a sentence where the surface is not the body's."""
    if gap < MIN_WORN_M:
        return []
    return [
        f"the surface lies {100 * gap:.1f} cm from the body beneath in the mean: vertices are the surface, garments and"
        " hair included, body_vertices and joints are the body's"
    ]


def _refuse_no_person(person: ScanPerson, found: FrameFit) -> None:
    """Raise InputError when a cloud has no person's size and, scaled to one, no person's shape."""
    guessed = found.unit.name == GUESS and len(person.units) > 1
    if guessed and not found.fit.reliable and not has_size_of_person(person.points):
        longest = float(np.ptp(person.points, axis=0).max())
        raise InputError(
            f"the longest side is {longest:.3g} units, which is not the size of an adult in m, cm or mm, and no scaled"
            " body fits; cut out one person, add --scene or name --unit"
        )


def _describe_frame(found: FrameFit) -> list[str]:
    """Return what the user should know about the unit and the axes, a sentence each."""
    notes = []
    if not found.up_clear:
        notes.append(f"which way is up is not clear, {_name_axis(found.frame.up)} was taken; name it with --up")
    if found.unit.name == GUESS:
        notes.append(
            f"no unit gives an adult's size, {found.unit.metres:.4g} metres per unit was guessed from the proportions;"
            " name --unit, also for a child"
        )
    elif found.is_child:
        notes.append(
            f"the person is {found.stature:.2f} m tall in {found.unit.name}: a child, or the scan was scaled; check"
            " --unit"
        )
    elif not found.unit_clear:
        notes.append(f"the unit is not clear, {found.unit.name} was taken; name it with --unit")
    return notes


def _name_axis(up: np.ndarray) -> str:
    k = int(np.abs(up).argmax())
    return ("-" if up[k] < 0 else "") + "xyz"[k]


def _progress_on(bar: tqdm) -> Progress:
    return lambda done: bar.update(int(100 * done) - bar.n) and None


def _write_fit(
    output: Path, model: StitchedPuppet, found: FrameFit, seconds: float, measured: Mapping[str, float]
) -> None:
    """Write the fit, in the scan's frame and unit, as `output` and as a mesh beside it."""
    frame, fit = found.frame, found.fit
    vertices = to_smallest_float(frame.to_scan(fit.vertices))
    body = model.vertices(fit.state)
    arrays: dict[str, Any] = {
        "vertices": vertices,
        "body_vertices": frame.to_scan(body).astype(vertices.dtype),
        "surface_to_body": measure_part_gaps(model, body, fit.vertices) / frame.scale,
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
        "metres_per_unit": found.unit.metres,
        "unit": found.unit.name,
        "unit_clear": found.unit_clear,
        "child": found.is_child,
        "up": frame.up,
        "up_clear": found.up_clear,
        "seconds": seconds,
        "model": model.name,
    }
    if measured:
        arrays |= {"measurement_names": np.array(list(measured)), "measurements": np.array(list(measured.values()))}
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
