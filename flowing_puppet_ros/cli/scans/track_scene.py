# SPDX-License-Identifier: Apache-2.0
"""Track the people in a folder of scans of a scene in time order, for `flowing-puppet fit --scene FOLDER`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.fit.up_axis_search import FrameFit, measure_stature
from flowing_puppet_ros.body.scans.scan import Scan, read_scan
from flowing_puppet_ros.body.scans.scan_frame import ScanFrame, parse_axis, rotation_to_z_up
from flowing_puppet_ros.body.scans.unit import ScanUnit
from flowing_puppet_ros.body.scene.scene_cloud import SceneCloud
from flowing_puppet_ros.body.segmentation.people import segment_people
from flowing_puppet_ros.body.track.scene_tracker import SceneSettings, SceneTracker
from flowing_puppet_ros.body.track.tracked_body import TrackedBody, TrackStatus
from flowing_puppet_ros.cli.scans.fit_file import make_fitter, write_result
from flowing_puppet_ros.cli.scans.fit_people import FitOptions, list_scene_ups
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.image.formats.video_reader import natural_sort_key
from flowing_puppet_ros.reporting import Report


def track_scene(
    sources: Sequence[Path], rate: float, options: FitOptions, report: Callable[[dict[str, Any]], None]
) -> int:
    """Track everybody through scans that follow one another, write a result a person and scan, and report each scan.

    Args:
        sources: the scans; their names are sorted as people count, so that scan10 comes after scan9.
        rate: scans per second.
        options: as of a fit; all scans have one unit, and the up axis that shows people in the first that has some.
        report: takes the summary of a scan, or its error.

    Returns:
        The exit status: 1 when a scan cannot be used.

    Raises:
        InputError: when two scans have one name, or people need not be upright.
        PuppetError: when nobody is in any scan.
    """
    ordered = sorted(sources, key=natural_sort_key)
    stems = [source.stem for source in ordered]
    double = next((stem for stem in stems if stems.count(stem) > 1), None)
    if double is not None:
        raise InputError(f"several scans are called {double}, and so would their results be; rename them")
    if options.upright == "any":
        raise InputError("people who are tracked through a folder are upright; name its files, or leave --upright")
    fitter = make_fitter(options.model, options.settings)
    unit = ScanUnit.named("m" if options.unit == "auto" else options.unit)
    settings = SceneSettings(view=options.view, segmentation=options.segmentation)
    told = Report()
    tracker, frame = SceneTracker(fitter, settings, told), None
    status, seen = 0, 0
    for number, source in enumerate(ordered):
        started = time.perf_counter()
        try:
            scan = read_scan(source)
            frame = frame or _find_frame(scan, unit, fitter, settings, options)
            bodies = _step(tracker, scan, frame, round(1e9 * (number + 1) / rate), number, options)
        except PuppetError as error:
            status = 1
            print(f"flowing-puppet fit: {error}", file=sys.stderr)
            report({"input": str(source), "error": str(error)})
            continue
        seen += len(bodies)
        view = "single" if tracker.sees_one_side else "full"
        each = (time.perf_counter() - started) / max(1, len(bodies))
        people, notes = [], told.drain_warnings()
        for body in bodies:
            assert frame is not None
            stature = measure_stature(fitter.model, body.fit.joints)
            found = FrameFit(frame, unit, body.fit, True, True, stature)
            name = f"{source.stem}-{body.id}"
            people.append({"id": body.id} | write_result(name, fitter.model, found, view, tuple(notes), each, options))
        report({"input": str(source), "people": people})
    if not seen and not status:
        raise PuppetError(f"there is nobody in the {len(ordered)} scans of {ordered[0].parent}")
    return status


def _find_frame(
    scan: Scan, unit: ScanUnit, fitter: BodyFitter, settings: SceneSettings, options: FitOptions
) -> ScanFrame | None:
    """Return the frame, z up, in which the people found in a scan are likeliest; None if nobody is found.

    An axis that was named is taken at once.
    """
    if options.up != "auto":
        return ScanFrame(unit.metres, rotation_to_z_up(parse_axis(options.up)))
    tried = []
    for up in list_scene_ups(options):
        frame = ScanFrame(unit.metres, rotation_to_z_up(up))
        tracker = SceneTracker(fitter, settings)
        cloud = _make_cloud(scan, frame, 0, options)
        one_sided = tracker.is_one_sided_scene(cloud)
        people = (
            [body.person for body in tracker.find_once(cloud)]
            if one_sided
            else segment_people(cloud.points, None, options.segmentation)
        )
        # The rays of one sensor tell more than the size of a cluster, which furniture may have in a wrong frame.
        tried.append((bool(one_sided and people), sum(person.score for person in people), frame))
    _, score, best = max(tried, key=lambda each: each[:2])
    return best if score > 0 else None


def _step(
    tracker: SceneTracker, scan: Scan, frame: ScanFrame | None, stamp: int, seed: int, options: FitOptions
) -> list[TrackedBody]:
    """Return the bodies of everybody who is seen; nobody while nothing says which way is up."""
    if frame is None:
        return []
    bodies, _ = tracker.step(_make_cloud(scan, frame, stamp, options), seed)
    return [body for body in bodies if body.status != TrackStatus.HIDDEN]


def _make_cloud(scan: Scan, frame: ScanFrame, stamp: int, options: FitOptions) -> SceneCloud:
    given = options.viewpoint if options.viewpoint is not None else scan.viewpoint
    sensor = np.zeros(3) if given is None else np.asarray(given, float)
    return SceneCloud(
        frame.to_body(scan.points), None, stamp, options.view == "single", viewpoint=frame.to_body(sensor)
    )
