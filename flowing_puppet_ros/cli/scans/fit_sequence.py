# SPDX-License-Identifier: Apache-2.0
"""Fit scans of one person over time with one shape, for `flowing-puppet fit --sequence`."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.fit.shared_shape import fit_with_shape, mean_shape
from flowing_puppet_ros.body.fit.up_axis_search import FrameFit
from flowing_puppet_ros.body.scans.scan import read_scan
from flowing_puppet_ros.cli.scans.fit_file import fit_scan_person, make_fitter, refuse_overwriting, write_result
from flowing_puppet_ros.cli.scans.fit_people import FitOptions, ScanPerson, find_people
from flowing_puppet_ros.errors import InputError

START_CONFIDENCE = 0.3
"""Of the joints of the body before: limbs may have moved."""
MAX_DISTANCE_RATIO = 1.5
"""Distance between body and scan, in that of the scan before, up to which a body that starts there is kept."""


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """One scan of the sequence, its person, and the body that was fitted to it alone."""

    source: Path
    person: ScanPerson
    found: FrameFit
    seconds: float


def fit_sequence(sources: Sequence[Path], options: FitOptions, report: Callable[[dict[str, Any]], None]) -> None:
    """Fit one person in all scans, in their order, write the results and report a summary for each.

    All scans have the unit and the up axis of the first. Every body but the first starts from the one before, and is
    searched anew where that fails. Then all get one shape.

    InputError when a scan cannot be used or shows several people.
    """
    stems = [source.stem for source in sources]
    if len(set(stems)) < len(stems):
        double = next(stem for stem in stems if stems.count(stem) > 1)
        raise InputError(f"several inputs are called {double}, and so would their results be; rename them")
    fitter = make_fitter(options.model, options.settings)
    seen: list[_Seen] = []
    for source in sources:
        refuse_overwriting(source, options)
        started = time.perf_counter()
        person = _find_person(source, fitter, options)
        found = (
            fit_scan_person(person, fitter, options, lambda _: None)
            if not seen
            else _fit_next(person, fitter, seen[-1].found)
        )
        seen.append(_Seen(source, person, found, time.perf_counter() - started))
    shape = mean_shape([each.found.fit for each in seen])
    for each in seen:
        started = time.perf_counter()
        fit = fit_with_shape(fitter, each.found.fit, _prepare(each.person, fitter, each.found), shape)
        seconds = each.seconds + time.perf_counter() - started
        view = "full" if each.person.sensor is None else "single"
        found = replace(each.found, fit=fit)
        notes = each.person.notes
        summary = write_result(each.source.stem, fitter.model, found, view, notes, seconds, options)
        report({"input": str(each.source)} | summary)


def _find_person(source: Path, fitter: BodyFitter, options: FitOptions) -> ScanPerson:
    people = find_people(read_scan(source), source, fitter, options)
    if len(people) > 1:
        raise InputError(f"{source} shows {len(people)} people and --sequence fits one; cut out the same person in all")
    return people[0]


def _fit_next(person: ScanPerson, fitter: BodyFitter, before: FrameFit) -> FrameFit:
    """Return the fit that starts from the one before, or a new one if that is not as near."""
    frame = before.frame
    points = frame.to_body(person.points)
    normals = None if person.normals is None else person.normals @ frame.rotation.T
    viewpoint = None if person.sensor is None else frame.to_body(person.sensor)
    fits: list[BodyFit] = []
    joints = dict(zip(fitter.model.joint_names, before.fit.joints, strict=True))
    step = points.mean(axis=0) - before.fit.vertices.mean(axis=0) if viewpoint is None else np.zeros(3)
    initial = {name: (*(place + step).tolist(), START_CONFIDENCE) for name, place in joints.items()}
    with suppress(InputError):  # the person went too far
        fits.append(fitter.fit(points, normals, initial=initial, viewpoint=viewpoint))
    limit = MAX_DISTANCE_RATIO * before.fit.two_way_distance
    if not fits or not fits[0].reliable or fits[0].two_way_distance > limit:
        fits.append(fitter.fit(points, normals, viewpoint=viewpoint))
    return replace(before, fit=min(fits, key=lambda fit: (not fit.reliable, fit.two_way_distance)))


def _prepare(person: ScanPerson, fitter: BodyFitter, found: FrameFit) -> Any:
    frame = found.frame
    normals = None if person.normals is None else person.normals @ frame.rotation.T
    viewpoint = None if person.sensor is None else frame.to_body(person.sensor)
    return fitter.prepare_cloud(frame.to_body(person.points), normals, viewpoint)
