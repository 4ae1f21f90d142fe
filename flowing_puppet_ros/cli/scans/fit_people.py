# SPDX-License-Identifier: Apache-2.0
"""The people to fit in one file for `flowing-puppet fit`: who is there, in what units, which axes may be up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.fit.up_axis_search import choose_up_axis, explain_roughly
from flowing_puppet_ros.body.scans.names import UNITS
from flowing_puppet_ros.body.scans.scan import Scan
from flowing_puppet_ros.body.scans.scan_frame import parse_axis, propose_up_axes
from flowing_puppet_ros.body.scans.unit import (
    MAX_LEFT_FLOOR_EXTENT_M,
    MAX_SCENE_EXTENT_M,
    METRIC_UNITS,
    MIN_SCENE_EXTENT_M,
    ScanUnit,
    is_closed,
    propose_named_unit,
    propose_sensor_units,
    propose_units,
)
from flowing_puppet_ros.body.scans.viewpoint import choose_viewpoint, find_viewpoint, is_seen_from
from flowing_puppet_ros.body.segmentation.pieces import Pieces, split_pieces
from flowing_puppet_ros.body.segmentation.up_axis import has_floor, segment_people_unknown_up
from flowing_puppet_ros.body.settings import FitterSettings, SegmentationSettings
from flowing_puppet_ros.errors import InputError, PuppetError

MAX_SCENE_POINTS = 300_000  # sampled from a scene
SCENE_UPS = ("z", "y", "-y")
"""Axes that are tried first for a scene; all are compared for the people that are found."""


MAX_ALONE_COST = 0.7
"""Cost of a rough body in a piece, in that of one in the whole scan, up to which the pieces are people: more than 1 for
halves of one person, a third for two people."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanPerson:
    """One person's cloud in a scan's frame and unit.

    Attributes:
        suffix: appended to the input's stem for the result.
        points: (N, 3).
        normals: (N, 3) or None.
        units: the scan's unit, or several that it may be in, the likeliest first.
        ups: directions (3,) that may be up, the most likely first.
        sensor: (3,) position of the sensor if the cloud shows one side, else None.
        notes: sentences for the user.
    """

    suffix: str
    points: np.ndarray
    normals: np.ndarray | None
    units: list[ScanUnit]
    ups: list[np.ndarray]
    sensor: np.ndarray | None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class FitOptions:
    """All options of a fit; see the flags of `fit`. Only `settings.threads` does not change the result."""

    out: Path = field(repr=False)
    model: str
    up: str
    upright: str
    unit: str
    view: str
    viewpoint: tuple[float, float, float] | None
    scene: bool
    settings: FitterSettings
    segmentation: SegmentationSettings
    camera_info: str | None = None
    color: Path | None = None
    measure: bool = False
    joints: tuple[tuple[str, tuple[float, float, float, float]], ...] = ()


def list_scene_ups(options: FitOptions) -> list[np.ndarray]:
    """Return the directions (3,) that may be up in a scene: those that are tried first, or the one that was named."""
    return [parse_axis(name) for name in (SCENE_UPS if options.up == "auto" else (options.up,))]


def find_people(scan: Scan, path: Path, fitter: BodyFitter, options: FitOptions) -> list[ScanPerson]:
    """Return the people of a scan: those in a scene, several who stand apart, or the only one.

    Raises:
        PuppetError: when a scene shows nobody.
        InputError: when the sensor of a single view cannot be found.
    """
    if options.scene:
        return _segment_scene(scan, path, fitter, options)
    pieces = split_pieces(scan)
    apart = _take_people_apart(pieces, path, fitter, options)
    if apart:
        return apart
    people = _segment_left_floor(pieces.scan, path, fitter, options)
    if people:
        return people
    return [_take_person(pieces.scan, "", fitter, options, _describe_pieces(pieces, path))]


def _take_people_apart(pieces: Pieces, path: Path, fitter: BodyFitter, options: FitOptions) -> list[ScanPerson]:
    """Return the people who stand apart, none when one body explains the scan better than one in each piece does."""
    if not pieces.are_people:
        return []
    note = f"{path} shows {len(pieces.large)} people apart from each other, each is fitted by itself"
    people = [
        _take_person(piece, f"-{number}", fitter, options, (note,))
        for number, piece in enumerate(pieces.large, start=1)
    ]
    one = _take_person(pieces.scan, "", fitter, options, ())
    together, *alone = (
        explain_roughly(fitter, person.points, person.units[0], person.ups, person.sensor).cost
        for person in (one, *people)
    )
    return people if max(alone) < MAX_ALONE_COST * together else []


def _describe_pieces(pieces: Pieces, path: Path) -> tuple[str, ...]:
    if not pieces.large:
        return ()
    return (
        f"{path} has {len(pieces.large)} large pieces apart from each other; add --scene if not all are one person",
    )


def _take_person(
    scan: Scan, suffix: str, fitter: BodyFitter, options: FitOptions, notes: tuple[str, ...]
) -> ScanPerson:
    """Return the only person of a scan."""
    points, normals = scan.sample_surface(fitter.settings.max_points, np.random.default_rng(fitter.settings.seed))
    sensor = None if options.view == "auto" and is_closed(scan) else _locate_sensor(points, normals, scan, options)
    units = _propose_units(scan, points, sensor, options)
    return ScanPerson(suffix, points, normals, units, _propose_ups(points, options), sensor, notes)


def _propose_units(scan: Scan, points: np.ndarray, sensor: np.ndarray | None, options: FitOptions) -> list[ScanUnit]:
    if options.unit != "auto":
        return propose_named_unit(points, options.unit)
    if sensor is not None and is_seen_from(points, np.zeros(3)):
        units = propose_sensor_units(points)
        if units:
            return units[:1]
    return propose_units(scan)


def _propose_ups(points: np.ndarray, options: FitOptions) -> list[np.ndarray]:
    if options.upright == "any" or options.up == "auto":
        return propose_up_axes(points, options.upright != "any")
    return [parse_axis(options.up)]


def _segment_left_floor(scan: Scan, path: Path, fitter: BodyFitter, options: FitOptions) -> list[ScanPerson]:
    """Return the people on a floor that was left in the scan, none when there is no floor or nobody on it."""
    longest = float(np.ptp(scan.points, axis=0).max())
    names = list(METRIC_UNITS) if options.unit == "auto" else [options.unit]
    unit = next(
        (name for name in names if MIN_SCENE_EXTENT_M <= longest * UNITS[name] <= MAX_LEFT_FLOOR_EXTENT_M), None
    )
    points = scan.sample_surface(fitter.settings.max_points, np.random.default_rng(fitter.settings.seed))[0]
    if unit is None or not has_floor(points * UNITS[unit]):
        return []
    try:
        people = _segment_scene(scan, path, fitter, options)
    except PuppetError:
        return []
    note = f"{path} shows more than a person: floor and walls were removed, as with --scene"
    people = [replace(person, notes=(note,)) for person in people]
    return [replace(people[0], suffix="")] if len(people) == 1 else people


def _group_scene_units(points: np.ndarray) -> list[list[ScanUnit]]:
    """Return the units in which a cloud (N, 3) has the size of a room or street: metric ones, then the others."""
    longest = float(np.ptp(points, axis=0).max())
    fitting = [name for name, metres in UNITS.items() if MIN_SCENE_EXTENT_M <= longest * metres <= MAX_SCENE_EXTENT_M]
    groups = [
        [ScanUnit.named(name) for name in fitting if (name in METRIC_UNITS) is metric] for metric in (True, False)
    ]
    return [group for group in groups if group] or [[ScanUnit.named("m")]]


def _segment_scene(scan: Scan, path: Path, fitter: BodyFitter, options: FitOptions) -> list[ScanPerson]:
    """Segment the people in the cloud of a scene; PuppetError if there is none."""
    points, normals = scan.sample_surface(MAX_SCENE_POINTS, np.random.default_rng(fitter.settings.seed))
    ups = list_scene_ups(options)
    sensor = None if options.view == "full" else _place_scene_sensor(scan, options)
    groups = _group_scene_units(points) if options.unit == "auto" else [[ScanUnit.named(options.unit)]]
    found: list[PersonCloud] = []
    for units in groups:
        results = []
        for unit in units:

            def choose(clouds: Sequence[np.ndarray], unit: ScanUnit = unit) -> np.ndarray:
                sensors = [_locate_sensor(cloud, None, scan, options) for cloud in clouds]
                return choose_up_axis(fitter, clouds, propose_up_axes(points, True), unit, sensors)

            results.append(
                (unit, *segment_people_unknown_up(
                    points, normals, unit.metres, ups, sensor, options.segmentation, choose
                ))
            )  # fmt: skip
        unit, up, found = _choose_scene_unit(results, fitter)
        if found:
            break
    if not found:
        raise PuppetError(
            f"{path} shows no person among its {len(points)} points; check --up and --unit, lower "
            "--segmentation-min-score, or cut the person out and leave --scene"
        )
    people = []
    for number, cloud in enumerate(found, start=1):
        seen = _locate_sensor(cloud.points, cloud.normals, scan, options)
        ways = propose_up_axes(cloud.points, False) if options.upright == "any" else [up]
        people.append(ScanPerson(f"-{number}", cloud.points, cloud.normals, [unit], ways, seen))
    return people


def _choose_scene_unit(
    results: list[tuple[ScanUnit, np.ndarray, list[PersonCloud]]], fitter: BodyFitter
) -> tuple[ScanUnit, np.ndarray, list[PersonCloud]]:
    """Return the unit, up and people of a scene in which a body explains the likeliest person best."""
    somebody = [result for result in results if result[2]] or results[:1]
    if len(somebody) == 1:
        return somebody[0]
    costs = [
        explain_roughly(fitter, people[0].points, unit, [up], None).cost * unit.metres for unit, up, people in somebody
    ]
    return somebody[int(np.argmin(costs))]


def _place_scene_sensor(scan: Scan, options: FitOptions) -> np.ndarray:
    if options.viewpoint is not None:
        return np.array(options.viewpoint)
    return np.zeros(3) if scan.viewpoint is None else scan.viewpoint


def _locate_sensor(
    points: np.ndarray, normals: np.ndarray | None, scan: Scan, options: FitOptions
) -> np.ndarray | None:
    """Return the position (3,) of the sensor of a cloud from one side, None for a cloud from all sides."""
    if options.view == "full":
        return None
    if options.viewpoint is not None:
        return np.array(options.viewpoint)
    if options.view == "auto":
        return find_viewpoint(points, scan.viewpoint)
    sensor = choose_viewpoint(points, normals, scan.viewpoint)
    if sensor is None:
        raise InputError(
            "--view single needs the place of the sensor, which is not outside of the cloud; name it with"
            " --viewpoint x,y,z"
        )
    return sensor
