# SPDX-License-Identifier: Apache-2.0
"""Rank the true wrists of annotated videos among random places near the person, by the maps of the hand detectors."""

from __future__ import annotations

import argparse
from pathlib import Path

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.image.hands import rank_wrists
from flowing_puppet_ros.evaluate.image.likelihood import format_ranks
from flowing_puppet_ros.evidence.image.hands import HandDetectors
from flowing_puppet_ros.image.formats.annotations import Annotations
from flowing_puppet_ros.learn.likelihood.samples import pose_people
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.process.threads import one_blas_thread


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `evaluate hands`."""
    parser.add_argument("annotations", type=Path, help="JSON of the annotation tool, or of joints per clip")
    parser.add_argument("--media", type=Path, help="folder of the images or videos [where the JSON is, or its clips/]")
    parser.add_argument("--every", type=int, default=5, help="use every n-th annotated frame [%(default)s]")
    parser.add_argument("--wrong", type=int, default=50, help="random places for each wrist [%(default)s]")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random places [%(default)s]")


def run(arguments: argparse.Namespace) -> int:
    """Print the table."""
    for name, low in (("every", 1), ("wrong", 1), ("seed", 0)):
        if getattr(arguments, name) < low:
            raise InputError(f"--{name} is {getattr(arguments, name)}; it must be {low} or more")
    model = DeformableStructures.load()
    annotations = Annotations.load(arguments.annotations, arguments.media)
    people = pose_people(annotations, model, arguments.every, True)
    with one_blas_thread():
        ranks = rank_wrists(model, HandDetectors.load(), people, arguments.wrong, arguments.seed)
    if not any(ranks.values()):
        raise InputError(f"{arguments.annotations} has no wrist that is reliable enough to be ranked; annotate some")
    print(format_ranks(ranks).replace("| part | terms |", "| hands | measure |"))
    return 0
