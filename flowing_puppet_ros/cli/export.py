# SPDX-License-Identifier: Apache-2.0
"""Write fitted bodies for other programs: meshes, skeletons, animations, markers.

RESULT is an .npz that `fit` wrote, or a recording that `replay` wrote, whose people become one file each. glb: mesh,
skeleton with skinning, animation, metres. bvh: skeleton and motion, centimetres. trc: joints as markers, millimetres.
obj: one mesh a frame, metres. json: joints, parts and bones by name, metres. All are y up and face z at rest.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from flowing_puppet_ros.body.scans.names import UP_AXES
from flowing_puppet_ros.exchange.formats import FORMATS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `export`."""
    parser.add_argument("inputs", nargs="+", type=Path, metavar="RESULT", help=".npz of `fit`, or a replayed bag")
    parser.add_argument("--to", choices=FORMATS, required=True, help="format")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the files")
    parser.add_argument(
        "--up",
        choices=(*UP_AXES, "auto"),
        default="auto",
        help="the axis that points up in the result's frame: of a fit the one that it found, in a bag -y in optical"
        " frames, else z [auto]",
    )
    parser.add_argument("--id", action="append", default=[], metavar="ID", help="only this person of a bag [all]")
    parser.add_argument("--json", action="store_true", help="print one JSON object an input")


def run(arguments: argparse.Namespace) -> int:
    """Export every result and say where the files are."""
    from flowing_puppet_ros.cli.work import export  # loaded for who does more than ask for help

    return export.run(arguments)
