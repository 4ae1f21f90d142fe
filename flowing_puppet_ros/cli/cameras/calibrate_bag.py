# SPDX-License-Identifier: Apache-2.0
"""Refine the calibration and the clocks of the cameras in a bag by the joints of the people who walk through it.

BAG has images, `camera_info` and poses on /tf_static; people come from its `puppets` (as `replay` writes them), its
`detections`, or the keypoint networks. The calibration in it has to be right to some degrees and decimetres. What is
written can be given to `import` again; TOML holds the clocks too.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from flowing_puppet_ros.image.networks.sources import SOURCE_HELP, SOURCES
from flowing_puppet_ros.multiview.rig.names import FORMS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this verb."""
    parser.add_argument("bag", type=Path, help="bag with images, camera_info and /tf_static of several cameras")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="calibration to write")
    parser.add_argument("--form", choices=tuple(FORMS), default="", help="form of it [by its name]")
    parser.add_argument("--intrinsics", action="store_true", help="adjust focal lengths and principal points too")
    parser.add_argument("--no-clocks", action="store_true", help="take the stamps of all cameras as they are")
    parser.add_argument("--max-offset", type=float, default=1.0, metavar="S", help="clock offset to look for [1 s]")
    parser.add_argument(
        "--distance",
        metavar="CAMERA,CAMERA,M",
        help="distance of two cameras, which fixes the scale [the distances as calibrated]",
    )
    parser.add_argument(
        "--person-height",
        type=float,
        default=0.0,
        metavar="M",
        help="height of the first person, which fixes the scale",
    )
    parser.add_argument("--source", default="auto", choices=SOURCES, help=SOURCE_HELP)
    parser.add_argument("--json", action="store_true", help="print the report as one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Calibrate."""
    from flowing_puppet_ros.cli.work import calibrate  # loaded for who does more than ask for help

    return calibrate.run(arguments)
