# SPDX-License-Identifier: Apache-2.0
"""Draw random bodies of a learned model: `ds`, the 2D puppet, or `sp`, the 3D one."""

from __future__ import annotations

import argparse

from flowing_puppet_ros.cli import sample_ds, sample_sp

MODELS = {"ds": sample_ds, "sp": sample_sp}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add one sub-command a model."""
    models = parser.add_subparsers(dest="model", required=True, metavar="ds|sp")
    for name, module in MODELS.items():
        module.add_arguments(models.add_parser(name, description=module.__doc__))


def run(arguments: argparse.Namespace) -> int:
    """Draw from the chosen model and return the exit status."""
    return MODELS[arguments.model].run(arguments)
