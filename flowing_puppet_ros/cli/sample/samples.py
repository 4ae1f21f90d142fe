# SPDX-License-Identifier: Apache-2.0
"""What the models of `flowing-puppet sample` have in common: flags, and the loop that draws."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.settings import make_out_folder


def add_common_arguments(parser: argparse.ArgumentParser, files: str) -> None:
    """Add the flags of every model; `files` names what is written."""
    parser.add_argument("--gender", default="neutral", help="neutral, female or male [%(default)s]")
    parser.add_argument("--count", type=int, default=8, help="samples [%(default)s]")
    parser.add_argument("--seed", type=int, default=0, help="seed of the samples [%(default)s]")
    parser.add_argument("--out", type=Path, required=True, help=f"folder for {files}")


def draw_samples(
    arguments: argparse.Namespace, draw: Callable[[argparse.Namespace, np.random.Generator], Iterator[Path]]
) -> int:
    """Draw from a model, print the paths of the files and return the exit status."""
    if arguments.count < 1:
        raise InputError(f"--count is {arguments.count}; draw at least 1")
    if arguments.seed < 0:
        raise InputError(f"--seed is {arguments.seed}; it must be 0 or more")
    make_out_folder(arguments.out)
    for path in draw(arguments, np.random.default_rng(arguments.seed)):
        print(path)
    return 0
