# SPDX-License-Identifier: Apache-2.0
"""Run the nodes' algorithms over a recording: every message, in log order, with the same result every time.

Each camera (a topic named image, with its camera_info and, if there are any, detections) is tracked; two or more
calibrated cameras give silhouettes and a visual hull; silhouettes, point clouds and depth images are fitted with
bodies. All results go into one bag with the stamps of the input, and so do camera_info, detections and /tf_static.
All cores work on a bag, or as many as --jobs says; the bytes are the same on any number.
Several bags are replayed in parallel, on this machine or on a Dask cluster, with the same results as one by one; those
that were finished by an earlier call with the same flags are skipped.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from flowing_puppet_ros.cli.batch import runner


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `replay`."""
    parser.add_argument(
        "inputs",
        nargs="+",
        type=Path,
        metavar="INPUT",
        help="bag: .mcap, .db3, .bag of ROS 1, a rosbag2 folder, or a folder of bags",
    )
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        help="output bag: a .mcap file, or a folder with metadata; of several inputs the folder of their .mcap files",
    )
    parser.add_argument("--rate", type=float, default=0.0, help="times the recording's speed; 0 is full speed [0]")
    parser.add_argument("--start-offset", type=float, default=0.0, metavar="S", help="leave out the first seconds [0]")
    parser.add_argument(
        "--playback-duration", type=float, default=math.inf, metavar="S", help="seconds to replay [all]"
    )
    parser.add_argument(
        "--topic-map", action="append", default=[], metavar="OLD:=NEW", help="rename a topic of the input (repeatable)"
    )
    parser.add_argument("--params", type=Path, help="YAML file with the parameters of the nodes")
    parser.add_argument(
        "--fixed-frame", default="", metavar="FRAME", help="map or odom: track people in it where the sensor moves"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of everything random [0]")
    parser.add_argument("--salvage", action="store_true", help="read what is whole of a truncated or damaged .mcap")
    parser.add_argument(
        "--report", type=Path, metavar="HTML", help="write a report with pictures and figures; of several, a folder"
    )
    parser.add_argument(
        "--rerun", type=Path, metavar="RRD", help="write a recording for the Rerun viewer; of several, a folder"
    )
    runner.add_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print a summary as one JSON object an input")


def run(arguments: argparse.Namespace) -> int:
    """Replay, report, and say where the results are."""
    from flowing_puppet_ros.cli.work import replay  # loaded for who does more than ask for help

    return replay.run(arguments)
