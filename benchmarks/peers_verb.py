# SPDX-License-Identifier: Apache-2.0
"""Compare fits and tracks with common alternatives, each in an environment of its own (made on demand by pip).

gradient: the 3D fit against gradient fitting of the Anny body with a chamfer loss in JAX. mediapipe: the 2D tracker
against MediaPipe 0.10.21 on annotated clips.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks import peer_runs
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.tables import format_json, format_table

PEERS = ("gradient", "mediapipe")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `flowing-puppet bench peers`."""
    parser.add_argument("peer", choices=PEERS, help="alternative to compare with")
    parser.add_argument("--env", type=Path, default=Path(".venv-peers"), help="folder of environments [%(default)s]")
    parser.add_argument("--count", type=int, default=3, help="gradient: number of people [%(default)s]")
    parser.add_argument("--seed", type=int, default=1, help="gradient: seed of the people [%(default)s]")
    parser.add_argument("--mocap", type=Path, metavar="NPZ", help="gradient: motion capture; without, hard poses")
    parser.add_argument("--clips", type=Path, metavar="DIR", help="mediapipe: folder of videos")
    parser.add_argument("--truth", type=Path, metavar="JSON", help="mediapipe: annotated joints of the clips")
    parser.add_argument("--names", default="", help="mediapipe: clips, separated by commas [all with a truth]")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")


def run(arguments: argparse.Namespace) -> int:
    """Measure, print the figures and return the exit status."""
    if arguments.count < 1:
        raise InputError(f"--count is {arguments.count}; fit at least 1 person")
    if arguments.seed < 0:
        raise InputError(f"--seed is {arguments.seed}; it must be 0 or more")
    if arguments.peer == "gradient":
        rows = peer_runs.compare_gradient(arguments.env, arguments.count, arguments.seed, arguments.mocap)
    else:
        if arguments.clips is None or arguments.truth is None:
            raise InputError("mediapipe is measured on annotated clips: name them with --clips and --truth")
        names = [name.strip() for name in arguments.names.split(",") if name.strip()]
        rows = peer_runs.compare_mediapipe(arguments.env, arguments.clips, arguments.truth, names)
    print(format_json({arguments.peer: rows}) if arguments.json else format_table(rows))
    return 0
