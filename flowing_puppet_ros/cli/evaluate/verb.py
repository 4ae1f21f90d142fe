# SPDX-License-Identifier: Apache-2.0
"""Measure poses and bodies against the ground truth."""

from __future__ import annotations

import argparse

from flowing_puppet_ros.cli.evaluate import bag, correspondence, hands, joints, likelihood, pcp, video
from flowing_puppet_ros.cli.evaluate.clouds import bodies, rgbd, scenes

KINDS = {
    "pcp": pcp,
    "joints": joints,
    "video": video,
    "bodies": bodies,
    "scenes": scenes,
    "rgbd": rgbd,
    "correspondence": correspondence,
    "bag": bag,
    "likelihood": likelihood,
    "hands": hands,
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add one sub-command per kind of measurement."""
    kinds = parser.add_subparsers(dest="kind_of_truth", required=True, metavar="|".join(KINDS))
    for name, module in KINDS.items():
        summary = (module.__doc__ or "").partition("\n")[0].rstrip(".").replace("%", "%%")
        module.add_arguments(kinds.add_parser(name, help=summary, description=module.__doc__))


def run(arguments: argparse.Namespace) -> int:
    """Run the chosen measurement and return the exit status."""
    return KINDS[arguments.kind_of_truth].run(arguments)
