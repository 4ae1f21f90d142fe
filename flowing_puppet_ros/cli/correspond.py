# SPDX-License-Identifier: Apache-2.0
"""Map every vertex of one scan to its point on another through two fits of one body model."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this verb."""
    parser.add_argument("fit_a", type=Path, metavar="A.npz", help="fit of scan A, as `fit` writes it")
    parser.add_argument("fit_b", type=Path, metavar="B.npz", help="fit of scan B")
    parser.add_argument("--scan-a", type=Path, required=True, metavar="FILE", help="scan A, a mesh or cloud")
    parser.add_argument("--scan-b", type=Path, required=True, metavar="FILE", help="scan B, a mesh or cloud")
    parser.add_argument("--out", type=Path, required=True, metavar="PAIRS.npz", help="points (N, 3), distance (N,)")
    parser.add_argument("--json", action="store_true", help="print a JSON object on stdout")


def run(arguments: argparse.Namespace) -> int:
    """Write each scan A vertex's point on scan B, in scan B's frame and unit."""
    from flowing_puppet_ros.cli.work import correspond  # loaded for who does more than ask for help

    return correspond.run(arguments)
