# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet evaluate rgbd`: bodies from colour and depth of drawn people whose every vertex is known."""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
from tqdm import tqdm

from flowing_puppet_ros.body.fit.fitter import BodyFitter, FitterSettings
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource
from flowing_puppet_ros.evaluate.rgbd.depth_sensor import SENSORS
from flowing_puppet_ros.evaluate.rgbd.methods import FusionMethod, RgbdMethod, SearchMethod
from flowing_puppet_ros.evaluate.rgbd.scores import RgbdScore, score_body, summarise_rgbd
from flowing_puppet_ros.evaluate.rgbd.views import CUTS, RgbdStudio, make_pair, make_registered
from flowing_puppet_ros.evaluate.tables import format_json, format_table, write_csv, write_json
from flowing_puppet_ros.image.networks.choice import IMAGE_SIDE_PX, load_networks
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.settings import make_out_folder

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
    parser.add_argument("--mocap", type=Path, metavar="NPZ", help="motion capture that the poses are from")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for rgbd.csv and rgbd.json")
    parser.add_argument("--json", action="store_true", help="print the figures as one JSON object")
    FitterSettings.add_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Fit the people of every frame, print the figures and return the exit status."""
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
    studio = RgbdStudio(BodySource(arguments.mocap), cameras, arguments.sensor)
    scores: list[RgbdScore] = []
    rows = [(cut, number) for cut in arguments.cuts for number in range(arguments.count)]
    for cut, number in tqdm(rows, file=sys.stderr, disable=arguments.json):
        rng = np.random.default_rng([arguments.people_seed, CUTS.index(cut), number])
        frame = studio.draw_frame(rng, cut, arguments.people, arguments.noise, arguments.any_pose)
        fits, to_world, seconds = method.find(frame)
        each = seconds / len(fits)
        scores += [score_body(fitter.model, fit, to_world, frame, k, cut, each) for k, fit in enumerate(fits)]
    figures = [summarise_rgbd([score for score in scores if score.cut == cut]) for cut in arguments.cuts]
    if arguments.out is not None:
        table = [asdict(score) for score in scores]
        write_csv(arguments.out / "rgbd.csv", table)
        write_json(arguments.out / "rgbd.json", {"summary": figures, "bodies": table})
    print(format_json({"summary": figures}) if arguments.json else format_table(figures))
    return 0


def _make_method(name: str, fitter: BodyFitter) -> RgbdMethod:
    if name == "search":
        return SearchMethod(fitter)
    return FusionMethod(fitter, load_networks("neural", IMAGE_SIDE_PX) if name == "networks" else None)
