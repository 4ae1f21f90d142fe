# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet evaluate bag`: the bodies of a replay against true joints, or against triangulated detections."""

from __future__ import annotations

import argparse
from pathlib import Path

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.evaluate.bag_truth import measured, read_truth
from flowing_puppet_ros.evaluate.tables import json_text, text_table, write_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `flowing-puppet evaluate bag`."""
    parser.add_argument("output", type=Path, metavar="OUT.mcap", help="the bag that the replay wrote")
    parser.add_argument("--input", type=Path, required=True, metavar="IN.mcap", help="the bag that was replayed")
    parser.add_argument("--truth", type=Path, metavar="JSON", help="true joints by stamp [triangulated detections]")
    parser.add_argument("--out", type=Path, metavar="JSON", help="file for the figures, of each joint too")
    parser.add_argument("--json", action="store_true", help="print the figures as one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Measure, print the figures in metres and return the exit status."""
    truth = None if arguments.truth is None else read_truth(arguments.truth)
    with open_bag(arguments.input, salvage=True) as given, open_bag(arguments.output, salvage=True) as made:
        errors, figures = measured(given, made, truth)
    joints = {name: one.summary() for name, one in errors.per_joint().items() if one.known.size}
    if arguments.out is not None:
        write_json(arguments.out, {"summary": figures, "joints": joints})
    print(json_text(figures) if arguments.json else text_table([{k.replace(" ", "_"): v for k, v in figures.items()}]))
    return 0
