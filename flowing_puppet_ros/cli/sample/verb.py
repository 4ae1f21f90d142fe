# SPDX-License-Identifier: Apache-2.0
"""Draw random bodies of a learned model: `ds`, the 2D puppet, or `sp`, the 3D one."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from flowing_puppet_ros.cli.sample import ds, sp
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.settings import make_out_folder

MODELS = {"ds": ds, "sp": sp}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add one sub-command per model."""
    models = parser.add_subparsers(dest="model", required=True, metavar="ds|sp")
    for name, module in MODELS.items():
        flags = models.add_parser(name, description=module.__doc__)
        flags.add_argument("--gender", default="neutral", help="neutral, female or male [%(default)s]")
        flags.add_argument("--count", type=int, default=8, help="samples [%(default)s]")
        flags.add_argument("--seed", type=int, default=0, help="seed of the samples [%(default)s]")
        flags.add_argument("--out", type=Path, required=True, help=f"folder for {module.FILES}")
        module.add_arguments(flags)


def run(arguments: argparse.Namespace) -> int:
    """Draw from the chosen model, print the paths of the files and return the exit status."""
    if arguments.count < 1:
        raise InputError(f"--count is {arguments.count}; draw at least 1")
    if arguments.seed < 0:
        raise InputError(f"--seed is {arguments.seed}; it must be 0 or more")
    make_out_folder(arguments.out)
    for path in MODELS[arguments.model].draw(arguments, np.random.default_rng(arguments.seed)):
        print(path)
    return 0
