# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet evaluate rgbd`: bodies from colour and depth of drawn people whose every vertex is known."""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource
from flowing_puppet_ros.evaluate.moving.camera_ring import CameraRing, RingScore, compare_cameras, summarise_ring
from flowing_puppet_ros.evaluate.moving.fitter_run import run_fitter
from flowing_puppet_ros.evaluate.moving.lost_depth import LOSSES, lose_depth
from flowing_puppet_ros.evaluate.moving.ring_evidence import compare_evidence
from flowing_puppet_ros.evaluate.moving.robot_view import SENSINGS, RobotView
from flowing_puppet_ros.evaluate.props.people import PROPS
from flowing_puppet_ros.evaluate.props.scenes import draw_props
from flowing_puppet_ros.evaluate.rgbd.depth_sensor import SENSORS
from flowing_puppet_ros.evaluate.rgbd.methods import FusionMethod, RgbdMethod, SearchMethod
from flowing_puppet_ros.evaluate.rgbd.scores import RgbdScore, score_body, summarise_rgbd, tabulate_calibration
from flowing_puppet_ros.evaluate.rgbd.tracking import MotionScore, summarise_motions, track_motion
from flowing_puppet_ros.evaluate.rgbd.views import CUTS, RgbdFrame, RgbdStudio, make_pair, make_registered
from flowing_puppet_ros.evaluate.tables import format_json, format_table, write_csv, write_json
from flowing_puppet_ros.image.networks.choice import load_networks
from flowing_puppet_ros.image.networks.pose_networks import BlazePose
from flowing_puppet_ros.image.networks.sources import IMAGE_SIDE_PX
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.settings import make_out_folder

MOTION_S = 2.5
METHODS = ("fusion", "networks", "search")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `flowing-puppet evaluate rgbd`."""
    parser.add_argument("--cuts", nargs="+", choices=CUTS, default=CUTS, help="what is seen of the people [all]")
    parser.add_argument(
        "--method",
        choices=METHODS,
        default="fusion",
        help="fusion: true joints with noise, and depth; networks: what the keypoint networks find in the drawn image,"
        " and depth; search: depth alone, whose points are whose being known [%(default)s]",
    )
    parser.add_argument("--count", type=int, default=20, help="frames of each kind [%(default)s]")
    parser.add_argument("--people", type=int, default=1, help="people side by side in a frame [%(default)s]")
    parser.add_argument("--people-seed", type=int, default=1, help="seed of the people and the sensor [%(default)s]")
    parser.add_argument("--sensor", choices=tuple(SENSORS), default="structured", help="kind of sensor [%(default)s]")
    parser.add_argument(
        "--noise", type=float, default=5.0, help="of the joints, px at a focal length of 525 px [%(default)s]"
    )
    parser.add_argument(
        "--unregistered", action="store_true", help="the colour camera is 5 cm beside, larger, with another lens"
    )
    parser.add_argument(
        "--any-pose", action="store_true", help="whole people crouch, bend and sit too, as motion capture has it"
    )
    parser.add_argument(
        "--motions", type=int, metavar="N", help="track so many fast motions instead, of 2.5 s each, of one person"
    )
    parser.add_argument(
        "--rates", nargs="+", type=float, default=[15.0, 30.0], help="at which they are tracked, Hz [15 30]"
    )
    parser.add_argument(
        "--lag", type=float, default=0.0, help="by which colour is later than depth in motions, seconds [%(default)s]"
    )
    parser.add_argument(
        "--robot", type=float, metavar="SECONDS", help="feed body_fitter with what a robot sees instead, which stands,"
        " drives and nods, hangs upside down, or whose colour and depth stand apart or are not of one time; no --mocap",
    )  # fmt: skip
    parser.add_argument(
        "--cameras", type=int, metavar="N", help="compare N depth cameras around the people with each of them alone"
    )
    parser.add_argument(
        "--lost-depth", nargs="+", choices=LOSSES, metavar="LOSS", help="whole people of whom depth is missing:"
        f" {', '.join(LOSSES)}; with --cameras, compare these cameras' depth, silhouettes and both together",
    )  # fmt: skip
    parser.add_argument(
        "--props", nargs="+", choices=PROPS, metavar="PROP", help="whole people with things that touch them: seated on"
        " stool, chair, armchair or sofa, a couple on one, at a desk, in a wheelchair, a child on a chair; behind a"
        " chair, leaning on a table's edge; with a box, backpack or bag",
    )  # fmt: skip
    parser.add_argument(
        "--masks", action="store_true", help="with masks of the people, by the installed network in the drawn images"
    )
    parser.add_argument("--mocap", type=Path, metavar="NPZ", help="motion capture that the poses are from")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for rgbd.csv and rgbd.json")
    parser.add_argument("--json", action="store_true", help="print the figures as one JSON object")
    FitterSettings.add_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Fit the people of every frame, print the figures and return the exit status."""
    if arguments.robot is not None:
        ways = _see_from_robot(arguments)
        print(format_json({"robot": ways}) if arguments.json else format_table(ways))
        return 0
    if "one" in (arguments.lost_depth or ()) and arguments.cameras is None:
        raise InputError("--lost-depth one takes the depth of all cameras but one away; give --cameras")
    if arguments.props and (arguments.lost_depth or arguments.motions or arguments.cameras or arguments.people > 1):
        raise InputError("--props draws whole people by itself: leave out --lost-depth, --motions, --cameras, --people")
    if arguments.mocap is None:
        raise InputError("drawn people stand and walk as motion capture does; give --mocap expmap_20hz.npz")
    if arguments.count < 1 or arguments.people < 1 or arguments.people_seed < 0 or not 0 <= arguments.noise <= 100:
        raise InputError("--count and --people are at least 1, --people-seed at least 0 and --noise between 0 and 100")
    fitter = BodyFitter(StitchedPuppet.load(), FitterSettings.from_arguments(arguments))
    fitter.warm_up()
    method = _make_method(arguments.method, fitter)
    if arguments.out is not None:
        make_out_folder(arguments.out)
    cameras = make_pair() if arguments.unregistered else make_registered()
    segmenter = BlazePose.load() if arguments.masks else None
    studio = RgbdStudio(BodySource(arguments.mocap), cameras, arguments.sensor, segmenter)
    if arguments.motions is not None:
        motions = _track_motions(arguments, fitter, studio)
        print(format_json({"motions": motions}) if arguments.json else format_table(motions))
        return 0
    if arguments.cameras is not None:
        rings = _look_from_around(arguments, fitter, studio)
        print(format_json({"cameras": rings}) if arguments.json else format_table(rings))
        return 0
    scores: list[RgbdScore] = []
    kinds = arguments.lost_depth or arguments.props or arguments.cuts
    for kind, number in tqdm(list(product(kinds, range(arguments.count))), file=sys.stderr, disable=arguments.json):
        frame = _draw_frame(arguments, studio, fitter.model, kind, number)
        fits, to_world, seconds = method.find(frame)
        each = seconds / len(fits)
        scores += [score_body(fitter.model, fit, to_world, frame, k, kind, each) for k, fit in enumerate(fits)]
    figures = [summarise_rgbd([score for score in scores if score.cut == kind]) for kind in kinds]
    printed = {"summary": figures, "calibration": tabulate_calibration(scores)}
    if arguments.out is not None:
        table = [asdict(score) for score in scores]
        write_csv(arguments.out / "rgbd.csv", table)
        write_json(arguments.out / "rgbd.json", {**printed, "bodies": table})
    print(format_json(printed) if arguments.json else "\n\n".join(map(format_table, printed.values())))
    return 0


def _draw_frame(
    arguments: argparse.Namespace, studio: RgbdStudio, model: StitchedPuppet, kind: str, number: int
) -> RgbdFrame:
    """Return a frame of one of CUTS, LOSSES or PROPS."""
    if arguments.props:
        rng = np.random.default_rng([arguments.people_seed, 200 + PROPS.index(kind), number])
        return draw_props(studio, rng, kind, arguments.noise)
    cut = "whole" if arguments.lost_depth else kind
    rng = np.random.default_rng([arguments.people_seed, CUTS.index(cut), number])
    frame = studio.draw_frame(rng, cut, arguments.people, arguments.noise, arguments.any_pose)
    return lose_depth([frame], kind, rng, model)[0] if arguments.lost_depth else frame


def _track_motions(arguments: argparse.Namespace, fitter: BodyFitter, studio: RgbdStudio) -> list[dict[str, float]]:
    """Track the motions and return the figures of each rate."""
    rates = sorted(set(arguments.rates), reverse=True)
    if arguments.motions < 1 or not 0 <= arguments.lag <= 1:
        raise InputError("--motions is at least 1 and --lag between 0 and 1 s")
    if any(rate <= 0 or rates[0] % rate for rate in rates):
        raise InputError(f"--rates are {arguments.rates} Hz; the highest must be a multiple of the others")
    scores: list[list[MotionScore]] = [[] for _ in rates]
    for number in tqdm(range(arguments.motions), file=sys.stderr, disable=arguments.json):
        rng = np.random.default_rng([arguments.people_seed, 100, number])
        found = track_motion(fitter, studio, rng, rates, MOTION_S, arguments.lag, arguments.noise)
        for each, score in zip(scores, found, strict=True):
            each.append(score)
    return [summarise_motions(each) for each in reversed(scores)]


def _look_from_around(arguments: argparse.Namespace, fitter: BodyFitter, studio: RgbdStudio) -> list[dict[str, Any]]:
    """Return the figures of one camera and of all around the people."""
    if not 2 <= arguments.cameras <= 8:
        raise InputError(f"--cameras is {arguments.cameras}; 2 to 8 can be compared with one")
    if arguments.lost_depth is not None:
        return _compare_evidence(arguments, fitter, studio)
    ring, scores = CameraRing(studio, arguments.cameras), dict[int, list[RingScore]]()
    for number in tqdm(range(arguments.count), file=sys.stderr, disable=arguments.json):
        rng = np.random.default_rng([arguments.people_seed, 500, number])
        for count, found in compare_cameras(fitter, ring, rng, arguments.people).items():
            scores.setdefault(count, []).extend(found)
    return [summarise_ring(count, found) for count, found in scores.items()]


def _compare_evidence(arguments: argparse.Namespace, fitter: BodyFitter, studio: RgbdStudio) -> list[dict[str, Any]]:
    """Return the figures of depth, silhouettes and both, for every loss of depth."""
    ring, scores = CameraRing(studio, arguments.cameras), dict[tuple[str, str], list[RingScore]]()
    for number in tqdm(range(arguments.count), file=sys.stderr, disable=arguments.json):
        seed = arguments.people_seed, number
        for kind, score in compare_evidence(fitter, ring, seed, arguments.people, arguments.lost_depth).items():
            scores.setdefault(kind, []).append(score)
    return [
        {"lost": loss, "from": evidence, **summarise_ring(arguments.cameras, found)}
        for (loss, evidence), found in scores.items()
    ]


def _see_from_robot(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the figures of every way in which a robot sees the same people."""
    if not 1 <= arguments.robot <= 60 or arguments.people_seed < 0:
        raise InputError("--robot is between 1 and 60 s and --people-seed at least 0")
    view = RobotView(BodySource(), arguments.people_seed, arguments.robot)
    ways = tqdm(list(SENSINGS), file=sys.stderr, disable=arguments.json)
    return [run_fitter(view, SENSINGS[name]).summarise(name) for name in ways]


def _make_method(name: str, fitter: BodyFitter) -> RgbdMethod:
    if name == "search":
        return SearchMethod(fitter)
    return FusionMethod(fitter, load_networks("neural", IMAGE_SIDE_PX) if name == "networks" else None)
