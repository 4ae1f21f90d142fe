# SPDX-License-Identifier: Apache-2.0
"""Output bags against true people: MPJPE, vertex to surface, ids, latency, drops; several runs side by side."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.evaluate.bag.figures import BagFigures, measure_bag
from flowing_puppet_ros.evaluate.bag.truth import PeopleByStamp, read_truth
from flowing_puppet_ros.evaluate.output import Chart, EvaluationReport, Line, name_runs
from flowing_puppet_ros.evaluate.output import add_arguments as add_output

LIMITS_CM = np.linspace(0, 20, 201)  # thresholds of the curve


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `flowing-puppet evaluate bag`."""
    parser.add_argument("outputs", nargs="+", type=Path, metavar="OUT.mcap", help="bag with the results of a run")
    parser.add_argument(
        "--input", type=Path, metavar="IN.mcap", help="bag that was replayed [the outputs hold their inputs, too]"
    )
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="FILE",
        help="true joints by stamp (JSON), or a bag with true bodies [joints triangulated from the detections]",
    )
    add_output(parser, "bag")


def run(arguments: argparse.Namespace) -> int:
    """Measure every run, print the figures and return the exit status."""
    truth = None if arguments.truth is None else read_truth(arguments.truth)
    names = name_runs(arguments.outputs)
    runs = {
        name: _measure_run(arguments.input or path, path, truth)
        for name, path in zip(names, arguments.outputs, strict=True)
    }
    details = {
        "joints, m": {
            name: {joint: one.summarise() for joint, one in found.errors.per_joint().items() if one.known.size}
            for name, found in runs.items()
        }
    }
    EvaluationReport("bag", {name: found.figures for name, found in runs.items()}, details, _make_charts(runs)).emit(
        arguments
    )
    return 0


def _measure_run(given: Path, made: Path, truth: PeopleByStamp | None) -> BagFigures:
    with open_bag(given, salvage=True) as input_bag, open_bag(made, salvage=True) as output_bag:
        return measure_bag(input_bag, output_bag, truth)


def _make_charts(runs: dict[str, BagFigures]) -> list[Chart]:
    known = {name: found for name, found in runs.items() if found.errors.known.size}
    within = [
        Line(name, LIMITS_CM, 100 * (100 * found.errors.known[:, None] <= LIMITS_CM).mean(axis=0))
        for name, found in known.items()
    ]
    over_time = [Line(name, found.seconds, 100 * found.errors.per_frame()) for name, found in known.items()]
    return [
        Chart("accuracy", "Joints of the bodies", "threshold, cm", "joints within, %", within, y_limits=(0, 100)),
        Chart("time", "Joints of the bodies", "time, s", "mean error, cm", over_time),
    ]
