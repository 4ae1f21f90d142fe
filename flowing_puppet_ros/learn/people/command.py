# SPDX-License-Identifier: Apache-2.0
"""Learn what tells people from what is none in scans of scenes."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.scans.scan_frame import UP_AXES, parse_axis, rotation_to_z_up
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.body.upright.person_model import POSED, UPRIGHT, PersonModel
from flowing_puppet_ros.learn.people.examples import CandidateExamples, collect_examples, read_scenes
from flowing_puppet_ros.learn.people.forest import learn_model
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.settings import make_out_folder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `learn people`."""
    parser.add_argument(
        "scenes", nargs="+", type=Path, help="folders with scans and labels.json; scans without labels show nobody"
    )
    parser.add_argument("--up", choices=UP_AXES, default="z", help="axis that points up in scans without labels [z]")
    parser.add_argument(
        "--max-fits", type=int, default=10, help="bodies fitted to what looks like a person, a scan [10]"
    )
    parser.add_argument(
        "--keep-forests", action="store_true", help="learn only how close joints are, to the shipped forests"
    )
    parser.add_argument("--posed", action="store_true", help="learn people who sit, bend or crouch, a model of its own")
    parser.add_argument("--seed", type=int, default=0, help="of all random draws [0]")
    parser.add_argument("--out", type=Path, required=True, help="folder for the weights and their model card")


def run(arguments: argparse.Namespace) -> int:
    """Learn, write the weights with their card and print the path."""
    make_out_folder(arguments.out)
    fitter = BodyFitter(StitchedPuppet.load(), FitterSettings())
    scenes = read_scenes(arguments.scenes, rotation_to_z_up(parse_axis(arguments.up)))
    examples = collect_examples(fitter, scenes, arguments.max_fits, arguments.seed, arguments.posed)
    name = POSED if arguments.posed else UPRIGHT
    model = learn_model(examples, arguments.seed, PersonModel.load(name) if arguments.keep_forests else None)
    path = arguments.out / f"people_{name}.npz"
    np.savez_compressed(path, **model.to_arrays())  # type: ignore[arg-type]
    path.with_suffix(".md").write_text(format_card(examples, model, arguments), encoding="utf-8")
    print(path)
    return 0


def format_card(examples: CandidateExamples, model: PersonModel, arguments: argparse.Namespace) -> str:
    """Describe the model, what it was learned from, and its limits."""
    return _CARD.format(
        folders=len(arguments.scenes),
        scans=len(np.unique(examples.scan)),
        people=int(examples.is_person.sum()),
        others=int((examples.is_person == 0).sum()),
        fits=int(examples.fitted.sum()),
        nodes=len(model.trees.feature) + len(model.judge.feature),
        trees=len(model.trees.roots),
        seed=arguments.seed,
    )


_CARD = """# People in scans of scenes

Tells people from what is none: a forest of {trees} trees over the shape and surroundings of a candidate, and one over
the same and what the rays of the scan say about the upright body that was fitted to it ({nodes} nodes in all), whose
odds are calibrated. A logistic regression says how likely the joints are within 10 cm. Calibration and regression are
by what forests say about scans that they have not learned from.

- Learned by `flowing-puppet learn people` from {folders} folders with {scans} scans that have candidates: {people}
  people and {others} other things; {fits} of all were fitted, and every body counts twice: with the candidate's points,
  and with those that it would have when tracked; seed {seed}.
- The shipped file was learned from synthetic rooms, streets and halls (`flowing-puppet evaluate scenes --write`; Anny
  bodies in poses of CMU motion capture, four kinds of scanners) and from one real cloud of an empty office (PCL test
  data, BSD). No scan with other terms was used, and no pose is in the file.
- How well it tells them: `flowing-puppet evaluate scenes`.
- Limits: it knows people who stand or walk, adults, alone and in groups. Real streets and halls hold things that no
  synthetic scene has.
- Licence: Apache-2.0, as the package.
"""
