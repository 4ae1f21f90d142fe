# SPDX-License-Identifier: Apache-2.0
"""Fit the 3D Stitched Puppet to meshes and clouds of one person each, or to the people in clouds of scenes.

Several inputs are fitted in parallel, on this machine or on a Dask cluster, with the same results as one by one; those
that were finished by an earlier call with the same flags are skipped.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from flowing_puppet_ros.body.scans.names import SUFFIXES, UNITS, UP_AXES
from flowing_puppet_ros.cli.batch import runner
from flowing_puppet_ros.cli.work.settings import FitVerbSettings
from flowing_puppet_ros.exchange.formats import FORMATS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument(
        "inputs", nargs="+", type=Path, metavar="INPUT", help=f"{' '.join(SUFFIXES)}, or a folder of them"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for <stem>.npz and <stem>.ply")
    parser.add_argument(
        "--model", choices=("neutral", "female", "male"), default="neutral", help="body model [neutral]"
    )
    FitVerbSettings.add_arguments(parser, main="fitter")
    parser.add_argument(
        "--up",
        choices=(*UP_AXES, "auto"),
        default="auto",
        help="the axis of the input's frame that points up; --up=-y in optical frames [auto]",
    )
    parser.add_argument(
        "--upright",
        choices=("yes", "any"),
        default="yes",
        help="whether people are upright along --up, or may lie or hang in any direction, whatever --up says [yes]",
    )
    parser.add_argument("--unit", choices=(*UNITS, "auto"), default="auto", help="the input's unit [auto]")
    parser.add_argument(
        "--view",
        choices=("full", "single", "auto"),
        default="auto",
        help="whether the input shows all sides, or one [auto]",
    )
    parser.add_argument(
        "--viewpoint",
        type=_parse_viewpoint,
        metavar="X,Y,Z",
        help="where the sensor of a one-sided input stood, in the input's frame and unit; --viewpoint=-1,0,2 where x is"
        " negative [what the file says, else the origin, else what the surface shows]",
    )
    parser.add_argument(
        "--scene",
        action="store_true",
        help="find the people among floor, walls and furniture first (in metres if --unit is auto); results are"
        " <stem>-1 and so on, the likeliest person first; a folder is scans in time order by name, through which people"
        " are tracked: results are <stem>-b1 and so on with the ids",
    )
    parser.add_argument(
        "--scan-rate", type=float, default=10.0, metavar="HZ", help="scans a second of such a folder [%(default)s]"
    )
    parser.add_argument(
        "--sequence",
        action="store_true",
        help="the inputs are scans of one person over time, in this order: one shape for all; --joints start the first",
    )
    parser.add_argument(
        "--camera-info",
        metavar="FILE|FX,FY,CX,CY",
        help="the input is a depth image (16-bit .png or .tif in --unit, mm if auto; or .npy) of this camera: a file"
        " with the fields of a CameraInfo, or four numbers in pixels; all people in it are fitted, in metres",
    )
    parser.add_argument(
        "--color",
        type=Path,
        metavar="IMAGE",
        help="colour image of the same pixels as the depth image or organised cloud: keypoint networks find the people"
        " in it; an organised .pcd with colours has its own",
    )
    parser.add_argument(
        "--joints",
        type=Path,
        metavar="JSON",
        help="start from 3D joints of the one person in the scan's frame and unit: "
        '{"joints": {"left_wrist": [x, y, z, confidence], ...}}',
    )
    parser.add_argument(
        "--measure",
        action="store_true",
        help="measure each person in a standard pose: stature, girths, lengths (m) and volume (m3)",
    )
    parser.add_argument(
        "--export", choices=FORMATS, help="also write each body for other programs, as the verb export does"
    )
    parser.add_argument("--rerun", type=Path, metavar="RRD", help="write the fits as a recording for the Rerun viewer")
    runner.add_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object per input on stdout")


def run(arguments: argparse.Namespace) -> int:
    """Fit every input; one that fails is reported and the others go on."""
    from flowing_puppet_ros.cli.work import fit  # loaded for who does more than ask for help

    return fit.run(arguments)


def _parse_viewpoint(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not three numbers x,y,z") from None
    if not all(map(math.isfinite, (x, y, z))):
        raise argparse.ArgumentTypeError(f"{text!r} is not three finite numbers x,y,z")
    return x, y, z
