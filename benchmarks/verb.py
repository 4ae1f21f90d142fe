# SPDX-License-Identifier: Apache-2.0
"""Measure speed as ratios in one run: look-ups, steps, search, growth, tracking, stages, scene, fits and more.

`bench peers` compares with common alternatives; the part `live` runs the nodes over DDS.
"""

from __future__ import annotations

import argparse
import json
import sys

from benchmarks import live
from benchmarks.speed import Bench
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.tables import format_table

SUBVERBS = {"peers": "benchmarks.peers_verb"}
PARTS = {
    "look-ups": Bench.measure_look_ups,
    "steps": Bench.measure_steps,
    "search": Bench.measure_search,
    "growth": Bench.measure_growth,
    "tracking": Bench.measure_tracking,
    "stages": Bench.measure_stages,
    "scene": Bench.measure_scene,
    "fits": Bench.measure_fits,
    "images": Bench.measure_images,
    "replay": Bench.measure_replay,
    "memory": Bench.measure_memory,
}
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
    bench, figures = Bench(arguments.seed), {}
    for part in arguments.parts or PARTS:
        print(f"measuring {part}", file=sys.stderr)
        is_live = part == LIVE
        figures[part] = live.run(arguments.seconds, arguments.seed) if is_live else PARTS[part](bench)
        if not arguments.json:
            what = live.__doc__ if is_live else PARTS[part].__doc__
            print(f"{part}: {what}\n{format_table(figures[part])}\n", flush=True)
    if arguments.json:
        print(json.dumps(figures))
    return 0
