# SPDX-License-Identifier: Apache-2.0
"""Fit the 3D Stitched Puppet to meshes and clouds of one person each."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
from tqdm import tqdm

from flowing_puppet_ros.body.fitter import BodyFit, BodyFitter, FitterSettings, Progress
from flowing_puppet_ros.body.frames import UNITS, UP_NAMES, Frame, guess_scale, up_candidates
from flowing_puppet_ros.body.io import Scan, read_scan, storable, write_ply
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.settings import make_out_folder
from flowing_puppet_ros.view.palette import part_colours

WRITTEN_SHAPES = 4


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
        help="the input's up axis; --up=-y in optical frames [auto]",
    )
    parser.add_argument("--unit", choices=(*UNITS, "auto"), default="auto", help="the input's unit [auto]")
    parser.add_argument(
        "--view",
        choices=("full", "single"),
        default="full",
        help="whether the input shows all sides, or one, seen from the origin of its frame [full]",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object per input on stdout")


def run(arguments: argparse.Namespace) -> int:
    """Fit every input; one that fails is reported and the others go on."""
    stems = Counter(path.stem for path in arguments.inputs)
    double = next((stem for stem, count in stems.items() if count > 1), None)
    if double is not None:
        raise InputError(f"two inputs are called {double!r} and would overwrite each other's result; fit them apart")
    make_out_folder(arguments.out)
    fitter = BodyFitter(StitchedPuppet.load(arguments.model), FitterSettings.from_arguments(arguments))
    status = 0
    for path in arguments.inputs:
        try:
            summary = _fit_file(path, fitter, arguments)
        except PuppetError as error:
            print(f"flowing-puppet fit: {error}", file=sys.stderr)
            summary = {"input": str(path), "error": str(error)}
            status = max(status, error.exit_status)
        if arguments.json:
            print(json.dumps(summary), flush=True)
    return status


def _fit_file(path: Path, fitter: BodyFitter, arguments: argparse.Namespace) -> dict[str, object]:
    started = time.perf_counter()
    scan = read_scan(path)
    with tqdm(total=100, desc=path.name, unit="%", file=sys.stderr, leave=not arguments.json) as bar:
        up, frame, fit = _best_fit(scan, fitter, arguments, bar)
    seconds = time.perf_counter() - started
    output = arguments.out / f"{path.stem}.npz"
    try:
        _write(output, fitter.model, frame, fit, seconds)
    except OSError as error:
        raise PuppetError(f"{output} cannot be written: {error.strerror}") from error
    return {
        "input": str(path),
        "output": str(output),
        "model": fitter.model.name,
        "energy": fit.energy,
        "confidence": fit.confidence,
        "two_way_distance_m": fit.two_way_distance,
        "metres_per_unit": frame.scale,
        "up": up,
        "seconds": seconds,
    }


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


def _best_fit(scan: Scan, fitter: BodyFitter, arguments: argparse.Namespace, bar: tqdm) -> tuple[str, Frame, BodyFit]:
    """Fit in every frame that the scan may have and keep the closest body, with the name of the axis that is up."""
    scale = guess_scale(scan) if arguments.unit == "auto" else UNITS[arguments.unit]
    single = arguments.view == "single"
    ups = up_candidates(scan, scale, single) if arguments.up == "auto" else [arguments.up]
    rng = np.random.default_rng(fitter.settings.seed)
    points, normals = scan.surface(fitter.settings.cloud_points, rng)
    sensor = _sensor(points, normals) if single else None
    fits = []
    for turn, up in enumerate(ups):
        frame = Frame(scale, UP_NAMES[up])
        viewpoint = None if sensor is None else frame.to_body(sensor)
        fit = fitter.fit(
            frame.to_body(points),
            None if normals is None else normals @ frame.rotation.T,
            viewpoint=viewpoint,
            progress=_shown(bar, turn, len(ups)),
        )
        fits.append((up, frame, fit))
    return min(fits, key=lambda triple: triple[2].two_way_distance)


def _shown(bar: tqdm, turn: int, turns: int) -> Progress:
    def show(done: float) -> None:
        bar.update(int(100 * (turn + done) / turns) - bar.n)

    return show


def _sensor(points: np.ndarray, normals: np.ndarray | None) -> np.ndarray:
    """Where the sensor stood: the origin when it lies outside the cloud, otherwise where the normals look."""
    low, high = points.min(axis=0), points.max(axis=0)
    if np.any((low > 0) | (high < 0)):
        return np.zeros(3)
    if normals is None:
        raise InputError("--view single needs the sensor at the origin of the input's frame, or normals; give either")
    mean = normals.mean(axis=0)
    return points.mean(axis=0) + 3 * float(np.ptp(points, axis=0).max()) * mean / max(float(np.linalg.norm(mean)), 1e-9)
