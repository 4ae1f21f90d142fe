# SPDX-License-Identifier: Apache-2.0
"""Write the videos of several cameras, their calibration, and keypoint files beside them into one bag for `replay`.

FOLDER has one video or one folder of images per camera, or `videos` or `images` with them. The calibration may be of
Pose2Sim, Anipose, Caliscope, EasyMocap, OpenCV, Qualisys, ROS or COLMAP. Unit and upright axis are checked by the
height of the people, which keypoint files or the networks show.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from flowing_puppet_ros.multiview.rig.names import AXES, UNITS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this verb."""
    parser.add_argument("folder", type=Path, help="folder with one video or one folder of images per camera")
    parser.add_argument("--calibration", type=Path, required=True, metavar="FILE", help="calibration file or folder")
    parser.add_argument("--out", type=Path, required=True, metavar="BAG", help="bag to write: .mcap, or else a folder")
    parser.add_argument(
        "--keypoints", type=Path, metavar="DIR", help="folder of the keypoint files [beside the videos]"
    )
    parser.add_argument("--unit", choices=(*UNITS, "auto"), default="auto", help="the calibration's unit [auto]")
    parser.add_argument(
        "--up", choices=(*AXES, "auto"), default="auto", help="axis of the calibration that points up; --up=-y [auto]"
    )
    parser.add_argument(
        "--person-height", type=float, default=0.0, metavar="M", help="height of the people, which fixes the scale"
    )
    parser.add_argument("--fps", type=float, default=0.0, help="images a second [of the videos; 30 for images]")
    parser.add_argument(
        "--crop",
        action="append",
        default=[],
        metavar="CAMERA=LEFT,TOP",
        help="columns and rows that a video lost after the calibration; may be given again",
    )
    parser.add_argument("--json", action="store_true", help="print a summary as one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Import the folder."""
    from flowing_puppet_ros.cli.work import import_folder  # loaded for who does more than ask for help

    return import_folder.run(arguments)
