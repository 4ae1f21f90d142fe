# SPDX-License-Identifier: Apache-2.0
"""Measure speed as ratios in one run: look-ups, steps, search, growth, tracking, stages, scene, fits and more.

`bench peers` compares with common alternatives; the part `live` runs the nodes over DDS.
"""

from __future__ import annotations

import argparse
import json
import sys

from flowing_puppet_ros.errors import InputError

SUBVERBS = {"peers": "benchmarks.peers_verb"}
PARTS = (
    "look-ups", "steps", "search", "growth", "tracking", "stages", "scene", "fits", "images", "replay", "memory",
)  # fmt: skip
"""Each is a method of `speed.Bench`."""
LIVE = "live"
MIN_SECONDS = 5.0  # of feeding a node


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `flowing-puppet bench`."""
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"{', '.join(PARTS)}; without any, all; or live")
    parser.add_argument("--seconds", type=float, default=60.0, help="how long live feeds each node [%(default)g]")
    parser.add_argument("--seed", type=int, default=0, help="seed of the body that is fitted [%(default)s]")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")


def run(arguments: argparse.Namespace) -> int:
    """Measure the chosen parts, print the figures and return the exit status."""
    unknown = next((part for part in arguments.parts if part not in (*PARTS, LIVE)), None)
    if unknown is not None:
        raise InputError(f"{unknown!r} is not a part of the bench; choose from {', '.join((*PARTS, LIVE))}")
    if arguments.seed < 0:
        raise InputError(f"--seed is {arguments.seed}; it must be 0 or more")
    if not MIN_SECONDS <= arguments.seconds < float("inf"):
        raise InputError(f"--seconds is {arguments.seconds:g}; it must be {MIN_SECONDS:g} or more")
    from benchmarks import live  # loaded for who does more than ask for help
    from benchmarks.speed import Bench
    from flowing_puppet_ros.evaluate.tables import format_table

    bench, figures = Bench(arguments.seed), {}
    for part in arguments.parts or PARTS:
        print(f"measuring {part}", file=sys.stderr)
        measure = None if part == LIVE else getattr(bench, f"measure_{part.replace('-', '_')}")
        figures[part] = measure() if measure else live.run(arguments.seconds, arguments.seed)
        if not arguments.json:
            print(f"{part}: {(measure or live).__doc__}\n{format_table(figures[part])}\n", flush=True)
    if arguments.json:
        print(json.dumps(figures))
    return 0
