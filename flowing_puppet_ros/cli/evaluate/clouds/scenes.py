# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet evaluate scenes`: people found in scans of scenes, labelled or synthetic, and bodies where nobody is.

Labels are one JSON table for all scans: the stem of a file gives a list of people, or {"sensor": [x, y, z], "people":
[...]}; each person has "centre" [x, y, z] and "height_width_length" in metres, and may have "points" and "joints".
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.scans.names import SUFFIXES, UP_AXES
from flowing_puppet_ros.body.scans.scan import read_scan
from flowing_puppet_ros.body.scans.scan_frame import parse_axis, rotation_to_z_up
from flowing_puppet_ros.body.scans.scene_labels import LabelledScene, label_scene, read_labels
from flowing_puppet_ros.body.scene.scene_cloud import SceneCloud
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.body.track.scene_tracker import SceneSettings, SceneTracker
from flowing_puppet_ros.body.track.tracked_body import TrackedBody
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource
from flowing_puppet_ros.evaluate.props.scene_people import POSES, draw_empty_seat, draw_posed
from flowing_puppet_ros.evaluate.scene.reliability import tabulate_reliability
from flowing_puppet_ros.evaluate.scene.scene_score import (
    MIN_TOP_M,
    GhostScore,
    PersonScore,
    ReportedPerson,
    score_scene,
    summarise_scenes,
    tabulate_bins,
)
from flowing_puppet_ros.evaluate.scene.scene_sequences import draw_sequence
from flowing_puppet_ros.evaluate.scene.synthetic_scenes import (
    PLACES,
    SCANNERS,
    Draw,
    SceneKind,
    SyntheticScene,
    draw_scene,
)
from flowing_puppet_ros.evaluate.tables import format_json, format_table, write_csv, write_json
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.settings import make_out_folder

FRAME_NS = 100_000_000  # between the scans of a sequence


class _Scan(NamedTuple):
    """A scan to find people in: `points` (N, 3) m, z up, the sensor where the labels say, and its height if told."""

    name: str
    points: np.ndarray
    truth: LabelledScene
    sensor_height: float | None = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `flowing-puppet evaluate scenes`."""
    parser.add_argument("scans", nargs="*", type=Path, metavar="SCAN", help="files or folders; none: synthetic scenes")
    parser.add_argument("--labels", type=Path, metavar="JSON", help="who is in the scans; without it, nobody")
    parser.add_argument("--up", choices=UP_AXES, default="z", help="axis of the scans that points up [%(default)s]")
    parser.add_argument("--sensor", type=float, nargs=3, metavar=("X", "Y", "Z"), help="overrides the labels' [0 0 0]")
    parser.add_argument(
        "--sector", type=float, default=180.0, help="degrees to either side of x that are labelled [180]"
    )
    parser.add_argument("--min-labelled-points", type=int, default=50, help="points of people who count [%(default)s]")
    parser.add_argument(
        "--sequence", action="store_true", help="the scans follow each other by 0.1 s: track the people"
    )
    parser.add_argument(
        "--length", type=int, default=1, help="scans of a synthetic sequence, whose people are tracked [%(default)s]"
    )
    parser.add_argument("--count", type=int, default=12, help="synthetic scenes [%(default)s]")
    parser.add_argument("--places", nargs="+", choices=PLACES, default=PLACES, help="of synthetic scenes [all]")
    parser.add_argument("--scanners", nargs="+", choices=SCANNERS, default=SCANNERS[:3], help="[the first three]")
    parser.add_argument("--people", type=int, default=4, help="people in a synthetic scene [%(default)s]")
    parser.add_argument(
        "--lookalikes", type=int, default=0, help="more things that stand as people do, a scene [%(default)s]"
    )
    parser.add_argument(
        "--covered", type=float, default=0.0, help="share of people with a table or car before them [%(default)s]"
    )
    parser.add_argument(
        "--rain", type=float, default=0.0, metavar="SHARE", help="share of the rays that meet a drop [%(default)s]"
    )
    parser.add_argument(
        "--poses", nargs="+", choices=POSES, default=(), help="of the people in turn; without it, they stand or walk"
    )
    parser.add_argument("--seats", type=int, default=0, help="empty chairs, sofas and the like, a scene [%(default)s]")
    parser.add_argument("--sensor-height", type=float, metavar="M", help="over the floor; without it, drawn")
    parser.add_argument(
        "--tell-height", action="store_true", help="the sensor's height is known, whether a floor is seen or not"
    )
    parser.add_argument("--scene-seed", type=int, default=1, help="seed of the synthetic scenes [%(default)s]")
    parser.add_argument(
        "--mocap", type=Path, metavar="NPZ", help="motion capture that synthetic people's poses are from"
    )
    parser.add_argument(
        "--write", type=Path, metavar="DIR", help="only write the synthetic scenes and labels.json there"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for people.csv, ghosts.csv and scenes.json")
    parser.add_argument("--json", action="store_true", help="print the figures as one JSON object")
    FitterSettings.add_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Find the people in every scan, print the figures and return the exit status."""
    if arguments.write is not None:
        return _write_scenes(arguments)
    if arguments.scans:
        scans = list(_read_scans(arguments))
    else:
        scans = [_as_scan(*drawn, arguments.tell_height) for drawn in _draw(arguments)]
    for folder in [arguments.out] if arguments.out is not None else []:
        make_out_folder(folder)
    model = StitchedPuppet.load()
    tracker = SceneTracker(BodyFitter(model, FitterSettings.from_arguments(arguments)), SceneSettings(view="single"))
    tracker.warm_up()
    people: list[PersonScore] = []
    ghosts: list[GhostScore] = []
    seconds = []
    sequence = arguments.sequence or arguments.length > 1
    for number, scan in enumerate(tqdm(scans, file=sys.stderr, disable=arguments.json)):
        if not arguments.scans and number % arguments.length == 0:
            tracker.reset()
        started = time.process_time()
        bodies = _find(tracker, scan, number, sequence)
        seconds.append(time.process_time() - started)
        found = [_describe(model, body, scan.truth.sensor) for body in bodies]
        limits = arguments.min_labelled_points, np.radians(arguments.sector)
        # Who stands in view shows the head; of who is low, nobody is left out.
        scored = score_scene(scan.name, scan.truth, found, *limits, 0.0 if arguments.poses else MIN_TOP_M)
        people += scored[0]
        ghosts += scored[1]
    figures = summarise_scenes(people, ghosts, len(scans)) | {"seconds_per_scan": float(np.mean(seconds))}
    bins = tabulate_bins(people)
    reliability = tabulate_reliability(people, ghosts)
    if arguments.out is not None:
        for name, rows in (("people", people), ("ghosts", ghosts)):
            if rows:
                write_csv(arguments.out / f"{name}.csv", [asdict(row) for row in rows])
        write_json(arguments.out / "scenes.json", {"summary": figures, "bins": bins, "reliability": reliability})
    if arguments.json:
        print(format_json(figures | {"bins": bins, "reliability": reliability}))
    else:
        print(format_table([figures]))
        print(format_table(bins) if bins else "nobody is labelled")
        if reliability:
            print(format_table(reliability))
    return 0


def _find(tracker: SceneTracker, scan: _Scan, number: int, sequence: bool) -> list[TrackedBody]:
    points, stamp = scan.points - scan.truth.sensor, FRAME_NS * (number + 1)
    cloud = SceneCloud(points, None, stamp, single_view=True, sensor_height=scan.sensor_height)
    try:
        return tracker.step(cloud, number)[0] if sequence else tracker.fit_once(cloud, number)
    except InputError:
        return []  # nobody


def _describe(model: StitchedPuppet, body: TrackedBody, sensor: np.ndarray) -> ReportedPerson:
    fit = body.fit
    stature = model.measure_height(fit.state.shape)
    joints = dict(zip(model.joint_names, fit.joints + sensor, strict=True))
    return ReportedPerson(joints, fit.vertices + sensor, stature, body.id, fit.confidence)


def _read_scans(arguments: argparse.Namespace) -> Iterator[_Scan]:
    labels = {} if arguments.labels is None else read_labels(arguments.labels)
    turn = rotation_to_z_up(parse_axis(arguments.up))
    paths = [
        path
        for given in arguments.scans
        for path in (sorted(p for p in given.iterdir() if p.suffix in SUFFIXES) if given.is_dir() else [given])
    ]
    for path in paths:
        points = read_scan(path).points @ turn.T
        truth = label_scene(labels.get(path.stem, []), points, path.stem)
        if arguments.sensor is not None:
            truth = LabelledScene(truth.people, turn @ np.array(arguments.sensor))
        yield _Scan(path.stem, points, truth)


def _draw(arguments: argparse.Namespace) -> Iterator[tuple[str, SyntheticScene, BodySource]]:
    if arguments.mocap is None:
        raise InputError("synthetic people stand and walk as motion capture does; give --mocap expmap_20hz.npz")
    source = BodySource(arguments.mocap)
    for number in range(arguments.count):
        place = arguments.places[number % len(arguments.places)]
        scanner = arguments.scanners[(number // len(arguments.places)) % len(arguments.scanners)]
        rng = np.random.default_rng([arguments.scene_seed, number])
        kind = SceneKind(
            arguments.lookalikes,
            arguments.covered,
            arguments.rain,
            arguments.sensor_height,
            _draw_in_turn(arguments.poses, number),
            (arguments.seats, draw_empty_seat) if arguments.seats else None,
        )
        drawn = (
            draw_sequence(source, rng, place, scanner, arguments.people, arguments.length, kind)
            if arguments.length > 1
            else [draw_scene(source, rng, place, scanner, arguments.people, kind)]
        )
        for step, scene in enumerate(drawn):
            suffix = f"-{step:03d}" if arguments.length > 1 else ""
            yield f"{number:03d}-{place}-{scanner}{suffix}", scene, source


def _draw_in_turn(poses: Sequence[str], first: int) -> Draw | None:
    """Return what draws people in these poses, one after the other; None where there are none."""
    if not poses:
        return None
    turn = cycle([*poses[first % len(poses) :], *poses[: first % len(poses)]])
    return lambda source, rng: draw_posed(source, rng, next(turn))


def _as_scan(name: str, scene: SyntheticScene, source: BodySource, tell_height: bool) -> _Scan:
    truth = label_scene(_label(scene, source), scene.points, name)
    return _Scan(name, scene.points, truth, -scene.floor if tell_height else None)


def _label(scene: SyntheticScene, source: BodySource) -> dict[str, Any]:
    """Return the labels of a synthetic scene, as in the JSON."""
    people = []
    for number, body in enumerate(scene.people):
        low, high = body.vertices.min(axis=0), body.vertices.max(axis=0)
        size = (high - low).tolist()
        people.append(
            {
                "centre": ((low + high) / 2).tolist(),
                "height_width_length": [size[2], size[0], size[1]],
                "stature": body.stature,
                "points": int(np.sum(scene.owner == number)),
                "joints": dict(zip(source.joint_names, body.joints.tolist(), strict=True)),
            }
        )
    return {"sensor": [0.0, 0.0, 0.0], "people": people}


def _write_scenes(arguments: argparse.Namespace) -> int:
    make_out_folder(arguments.write)
    labels = {}
    for name, scene, source in _draw(arguments):
        np.savez_compressed(arguments.write / f"{name}.npz", points=scene.points.astype(np.float32))
        labels[name] = _label(scene, source)
    (arguments.write / "labels.json").write_text(json.dumps(labels))
    return 0
