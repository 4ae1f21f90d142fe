# SPDX-License-Identifier: Apache-2.0
"""Make the HTML report of a replay, one self-contained file, from its output bag and, for images, its input bag."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `flowing-puppet report`."""
    parser.add_argument("output", type=Path, metavar="OUT.mcap", help="the bag written by the replay")
    parser.add_argument(
        "--input", type=Path, metavar="IN.mcap", help="the bag that was replayed [none: overlays instead of images]"
    )
    parser.add_argument("--out", type=Path, default=Path("report.html"), help="the report to write [report.html]")
    parser.add_argument("--picture", type=Path, metavar="PNG", help="also write a collage of the main pictures")


def run(arguments: argparse.Namespace) -> int:
    """Write the report and print its path."""
    from flowing_puppet_ros.report.report import write_report  # loaded for who does more than ask for help

    write_report(arguments.input or arguments.output, arguments.output, arguments.out, picture=arguments.picture)
    print(arguments.out)
    return 0
