# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet evaluate bodies`: fits of scanned synthetic people whose every vertex is known."""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from pathlib import Path

from tqdm import tqdm

from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.body.bodies import KINDS, BodyScore, draw_scans, score_fit, summarise
from flowing_puppet_ros.evaluate.body.measurements import measure_errors, summarise_errors
from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource
from flowing_puppet_ros.evaluate.tables import format_json, format_table, write_csv, write_json
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.settings import make_out_folder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `flowing-puppet evaluate bodies`."""
    parser.add_argument(
        "--kind", choices=KINDS, default="whole", help="whole scans, depth views, LiDAR or clothed people [%(default)s]"
    )
    parser.add_argument("--count", type=int, default=20, help="people [%(default)s]")
    parser.add_argument("--people-seed", type=int, default=1, help="seed of the people and their scans [%(default)s]")
    parser.add_argument("--mocap", type=Path, metavar="NPZ", help="motion capture; without it all poses are hard")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for bodies_KIND.csv and bodies_KIND.json")
    parser.add_argument("--measure", action="store_true", help="also print errors of measurements of fits")
    parser.add_argument("--json", action="store_true", help="print the figures as one JSON object")
    FitterSettings.add_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Fit every drawn person, print the figures and return the exit status."""
    if arguments.count < 1:
        raise InputError(f"--count is {arguments.count}; measure at least 1 person")
    if arguments.people_seed < 0:
        raise InputError(f"--people-seed is {arguments.people_seed}; it must be 0 or more")
    fitter = BodyFitter(StitchedPuppet.load(), FitterSettings.from_arguments(arguments))
    if arguments.out is not None:
        make_out_folder(arguments.out)
    source = BodySource(arguments.mocap)
    scans = draw_scans(arguments.kind, source, arguments.count, arguments.people_seed)
    scores: list[BodyScore] = []
    errors: list[dict[str, float]] = []
    with tqdm(scans, total=arguments.count, file=sys.stderr, disable=arguments.json) as bar:
        for body, scene, cloud in bar:
            beneath = arguments.kind == "clothed"
            fit, score = score_fit(fitter, body, scene, cloud, source.joint_names, beneath)
            scores.append(score)
            if arguments.measure:
                errors.append(measure_errors(fitter.model, fit, body, source.triangles))
            bar.set_postfix_str(f"{100 * scores[-1].vertex_error:.2f} cm")
    figures = summarise(scores)
    if arguments.out is not None:
        rows = [asdict(score) for score in scores]
        write_csv(arguments.out / f"bodies_{arguments.kind}.csv", rows)
        write_json(arguments.out / f"bodies_{arguments.kind}.json", {"summary": figures, "bodies": rows})
    measured = summarise_errors(errors) if errors else []
    if arguments.json:
        print(format_json(figures | ({"measurements": measured} if measured else {})))
    else:
        print(format_table([{"kind": arguments.kind} | figures]))
        if measured:
            print(format_table(measured))
    return 0
