# SPDX-License-Identifier: Apache-2.0
"""Rank the right limbs of annotated images among wrong ones, by the image likelihood with and without each term."""

from __future__ import annotations

import argparse
from pathlib import Path

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.image.likelihood import format_ranks, rank_limbs
from flowing_puppet_ros.evidence.image.likelihood import PartLikelihood
from flowing_puppet_ros.image.formats.annotations import Annotations
from flowing_puppet_ros.learn.likelihood.samples import pose_people
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

PARTS = 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `evaluate likelihood`."""
    parser.add_argument("annotations", type=Path, help="JSON of the annotation tool, or of joints per clip")
    parser.add_argument("--media", type=Path, help="folder of the images or videos [where the JSON is, or its clips/]")
    parser.add_argument("--every", type=int, default=10, help="of videos, use every n-th annotated frame [%(default)s]")
    parser.add_argument("--wrong", type=int, default=50, help="wrong limbs for each right one [%(default)s]")
    parser.add_argument("--seed", type=int, default=0, help="seed of the wrong limbs [%(default)s]")


def run(arguments: argparse.Namespace) -> int:
    """Print the table."""
    for name, low in (("every", 1), ("wrong", 1), ("seed", 0)):
        if getattr(arguments, name) < low:
            raise InputError(f"--{name} is {getattr(arguments, name)}; it must be {low} or more")
    model = DeformableStructures.load("neutral", PARTS)
    annotations = Annotations.load(arguments.annotations, arguments.media)
    people = pose_people(annotations, model, arguments.every)
    ranks = rank_limbs(model, PartLikelihood.load(PARTS), people, arguments.wrong, arguments.seed)
    if not any(ranks.values()):
        raise InputError(f"{arguments.annotations} has no part that is reliable enough to be ranked; annotate some")
    print(format_ranks(ranks))
    return 0
