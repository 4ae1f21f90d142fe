# SPDX-License-Identifier: Apache-2.0
"""Measure poses and bodies against the truth."""

from __future__ import annotations

import argparse

from flowing_puppet_ros.cli import (
    evaluate_bag,
    evaluate_bodies,
    evaluate_correspondence,
    evaluate_hands,
    evaluate_joints,
    evaluate_likelihood,
    evaluate_pcp,
    evaluate_video,
)

KINDS = {
    "pcp": evaluate_pcp,
    "joints": evaluate_joints,
    "video": evaluate_video,
    "bodies": evaluate_bodies,
    "correspondence": evaluate_correspondence,
    "bag": evaluate_bag,
    "likelihood": evaluate_likelihood,
    "hands": evaluate_hands,
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add one sub-command a kind of measurement."""
    kinds = parser.add_subparsers(dest="kind_of_truth", required=True, metavar="|".join(KINDS))
    for name, module in KINDS.items():
        summary = (module.__doc__ or "").partition("\n")[0].rstrip(".").replace("%", "%%")
        module.add_arguments(kinds.add_parser(name, help=summary, description=module.__doc__))


def run(arguments: argparse.Namespace) -> int:
    """Run the chosen measurement and return the exit status."""
    return KINDS[arguments.kind_of_truth].run(arguments)
