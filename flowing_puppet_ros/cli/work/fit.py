# SPDX-License-Identifier: Apache-2.0
"""What the verb `fit` does."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.body.measurements.measure import DEFINITIONS
from flowing_puppet_ros.body.scans.names import SCAN_SUFFIXES
from flowing_puppet_ros.body.scans.scan import read_scan
from flowing_puppet_ros.cli.batch import runner
from flowing_puppet_ros.cli.scans.fit_file import fit_file, list_files
from flowing_puppet_ros.cli.scans.fit_people import FitOptions
from flowing_puppet_ros.cli.scans.given_joints import read_joints
from flowing_puppet_ros.cli.work.settings import FitVerbSettings
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.exchange.files import write_people
from flowing_puppet_ros.exchange.motion import read_fit
from flowing_puppet_ros.settings import make_out_folder


def run(arguments: argparse.Namespace) -> int:
    """Fit every input; one that fails is reported and the others go on."""
    options = _make_options(arguments)
    sources = [runner.resolve_path(source, arguments) for given in arguments.inputs for source in _find_scans(given)]
    several = sources != arguments.inputs or len(sources) > 1 or arguments.scheduler is not None
    tracked = arguments.scene and arguments.camera_info is None and any(given.is_dir() for given in arguments.inputs)
    _refuse_contradictions(arguments, several, tracked)
    if arguments.rerun is not None:
        from flowing_puppet_ros.report.rerun_file import import_rerun

        import_rerun()
    finished: list[dict[str, Any]] = []

    def tell(summary: dict[str, Any]) -> None:
        _tell(summary, arguments.json)
        if arguments.export and "error" not in summary:
            _export(summary, arguments.export)
        finished.extend([] if "error" in summary else [summary])

    verb = runner.Verb("fit", fit_file, list_files, tell)
    if arguments.sequence:
        from flowing_puppet_ros.cli.scans.fit_sequence import (
            fit_sequence,  # the trackers are loaded for those who track
        )

        make_out_folder(options.out)
        fit_sequence(sources, options, tell)
        status = 0
    elif tracked:
        from flowing_puppet_ros.cli.scans.track_scene import track_scene

        make_out_folder(options.out)
        status = track_scene(sources, arguments.scan_rate, options, tell)
    elif several:
        status = runner.run_batch(verb, sources, options, arguments.out, arguments)
    else:
        status = _one(verb, sources[0], options)
    if arguments.rerun is not None and finished:
        from flowing_puppet_ros.report.rerun_file import write_fits

        write_fits(_fits(finished), arguments.rerun)
    return status


def _make_options(arguments: argparse.Namespace) -> FitOptions:
    settings = FitVerbSettings.from_arguments(arguments)
    return FitOptions(
        out=runner.resolve_path(arguments.out, arguments),
        model=arguments.model,
        up=arguments.up,
        upright=arguments.upright,
        unit=arguments.unit,
        view=arguments.view,
        viewpoint=arguments.viewpoint,
        scene=arguments.scene,
        camera_info=_resolve_info(arguments),
        color=None if arguments.color is None else runner.resolve_path(arguments.color, arguments),
        settings=settings.fitter,
        segmentation=settings.segmentation,
        measure=arguments.measure,
        joints=() if arguments.joints is None else tuple(read_joints(arguments.joints).items()),
    )


def _refuse_contradictions(arguments: argparse.Namespace, several: bool, tracked: bool) -> None:
    """Raise InputError where flags contradict one another or the inputs."""
    if arguments.sequence and (arguments.scene or arguments.scheduler is not None):
        raise InputError("--sequence fits one person in scans one after another; leave --scene and --scheduler")
    if arguments.joints is not None and (arguments.scene or (several and not arguments.sequence)):
        raise InputError("--joints are those of the person in one scan; give one INPUT, and leave --scene")
    if tracked and (len(arguments.inputs) > 1 or arguments.scheduler is not None):
        raise InputError(
            "--scene tracks people through the scans of one folder, one after another; give one folder and no"
            " --scheduler, or the files in it to fit each by itself"
        )
    if tracked and not 0 < arguments.scan_rate < np.inf:
        raise InputError(f"--scan-rate is {arguments.scan_rate:g}; give the scans a second, such as 10")


def _resolve_info(arguments: argparse.Namespace) -> str | None:
    """Return the numbers of --camera-info, or its file as other processes find it."""
    given: str | None = arguments.camera_info
    if given is None or given.count(",") == 3:
        return given
    return str(runner.resolve_path(Path(given), arguments))


def _export(summary: dict[str, Any], form: str) -> None:
    for fit in summary.get("people", [summary]):
        output = Path(fit["output"])
        write_people([read_fit(output)], form, output.parent)


def _one(verb: runner.Verb, source: Path, options: FitOptions) -> int:
    make_out_folder(options.out)
    try:
        verb.report(fit_file(source, options, shown=True))
    except PuppetError as error:
        verb.report({"input": str(source), "error": str(error)})
        raise
    return 0


def _fits(summaries: list[dict[str, Any]]) -> Iterator[tuple[str, np.ndarray, Path]]:
    for summary in summaries:
        points = read_scan(Path(summary["input"])).points
        for fit in summary.get("people", [summary]):
            output = Path(fit["output"])
            yield output.stem, points, output


def _find_scans(given: Path) -> list[Path]:
    """Yield an input, or the files of a folder that may be scans, by name."""
    if not given.is_dir():
        return [given]
    found = sorted(path for path in given.iterdir() if path.suffix.lower() in SCAN_SUFFIXES and path.is_file())
    if not found:
        raise InputError(f"the folder {given} has no scan; wanted are files ending in {' '.join(SCAN_SUFFIXES)}")
    return found


def _list_measurements(measured: dict[str, float]) -> str:
    return ", ".join(
        f"{name.replace('_', ' ')} {value:.3f} {DEFINITIONS[name].unit}" for name, value in measured.items()
    )


def _tell(summary: dict[str, Any], as_json: bool) -> None:
    for fit in summary.get("people", [summary]):
        notes = list(fit.get("notes", []))
        if not fit.get("reliable", True):
            notes.insert(0, f"{fit['output']} is not reliable: a limb may be wrong, or it is no person")
        elif notes:
            notes[0] = f"{fit['output']}: {notes[0]}"
        if notes:
            print(f"flowing-puppet fit: {'; '.join(notes)}", file=sys.stderr)
        if "measurements" in fit and not as_json:
            print(f"{fit['output']}: {_list_measurements(fit['measurements'])}", flush=True)
    if as_json:
        print(json.dumps(summary), flush=True)
