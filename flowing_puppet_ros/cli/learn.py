# SPDX-License-Identifier: Apache-2.0
"""Learn body models (`ds`, `sp`) from synthetic people; `likelihood`, `detector`, `hands` from annotated images."""

from __future__ import annotations

import argparse
from importlib import import_module
from types import ModuleType

from flowing_puppet_ros.extras import needing_extra

MODULES = {
    "ds": "ds.command",
    "sp": "sp.command",
    "likelihood": "likelihood.command",
    "detector": "detector.command",
    "hands": "thesis_loop.hands_command",
    "people": "people.command",
    "flowing": "thesis_loop.energy_weights_command",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add one sub-command per model; InputError if a package that only `learn` needs is missing."""
    kinds = parser.add_subparsers(dest="kind", required=True, metavar="|".join(MODULES))
    for name in MODULES:
        module = _import_kind(name)
        summary = (module.__doc__ or "").partition("\n")[0].rstrip(".").replace("%", "%%")
        module.add_arguments(kinds.add_parser(name, help=summary, description=module.__doc__))


def run(arguments: argparse.Namespace) -> int:
    """Learn the chosen model and return the exit status."""
    status: int = _import_kind(arguments.kind).run(arguments)
    return status


def _import_kind(name: str) -> ModuleType:
    with needing_extra("learn", "learn"):
        return import_module(f"flowing_puppet_ros.learn.{MODULES[name]}")
