# SPDX-License-Identifier: Apache-2.0
"""Learn a body model from synthetic people: `ds`, the 2D puppet, or `sp`, the 3D one (needs the Anny body)."""

from __future__ import annotations

import argparse

from flowing_puppet_ros.learn import ds, sp_command

MODELS = {"ds": ds, "sp": sp_command}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add one sub-command a model."""
    models = parser.add_subparsers(dest="model", required=True, metavar="ds|sp")
    for name, module in MODELS.items():
        module.add_arguments(models.add_parser(name, description=module.__doc__))


def run(arguments: argparse.Namespace) -> int:
    """Learn the chosen model and return the exit status."""
    return MODELS[arguments.model].run(arguments)
