# SPDX-License-Identifier: Apache-2.0
"""Find the weights of the energy of flowing puppets on annotated videos; print them and write a model card."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from flowing_puppet_ros.learn.annotations import add_annotation_arguments, load_annotations
from flowing_puppet_ros.learn.likelihood.samples import pose_people
from flowing_puppet_ros.learn.thesis_loop.energy_weights import WeightSettings, gather_choices, search_weights
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.settings import make_out_folder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `learn flowing`."""
    add_annotation_arguments(parser)
    parser.add_argument("--out", type=Path, required=True, help="folder for the model card flowing_weights.md")
    WeightSettings.add_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Search, write the card, and print the weights as JSON; progress on stderr."""
    settings = WeightSettings.from_arguments(arguments)
    annotations = load_annotations(arguments)
    make_out_folder(arguments.out)
    model = DeformableStructures.load()
    people = pose_people(annotations, model, settings.every, True)
    choices = gather_choices(model, people, settings, lambda step: print(step, file=sys.stderr))
    figures = search_weights(choices, settings)
    card = _CARD.format(
        people=len(choices.miss),
        files=len(annotations.people),
        puppets=settings.puppets,
        command=" ".join(
            [
                "flowing-puppet learn flowing ANNOTATIONS.json",
                *(["--leave-out TEST.json"] if arguments.leave_out else []),
                f"--every {settings.every} --puppets {settings.puppets} --draws {settings.draws}",
                f"--seed {settings.seed} --out DIR",
            ]
        ),
        weights="\n".join(f"| {name} | {value:g} |" for name, value in figures.items() if "miss" not in name),
        misses="\n".join(f"| {name} | {100 * value:.2f} cm |" for name, value in figures.items() if "miss" in name),
    )
    (arguments.out / "flowing_weights.md").write_text(card, encoding="utf-8")
    print(json.dumps(figures))
    return 0


_CARD = """# Weights of the energy of flowing puppets

What the terms of Eq. 35 of S. Zuffi's thesis count in `image.thesis_loop.energy.EnergySettings`, found by random
search on {people} people of {files} clips that are not among the annotated ones, with the command
`{command}`.
For each person {puppets} puppets around the true one were judged; the miss is the mean distance of elbows and wrists
(at most 30 cm each) of the puppet of least energy.

| weight | |
|---|---|
{weights}

| mean miss | |
|---|---|
{misses}

The detector's score was left out of the search, because the detector was learned on these clips: its weight was set by
hand. Held out: weights chosen on one half of the source videos, judged on the other. Joints are a network's (MediaPipe
Pose 0.10.21). Contour and hand filters were learned on the same clips, so their weights are rather too high.
"""
