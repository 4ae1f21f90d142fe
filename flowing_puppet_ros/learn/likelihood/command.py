# SPDX-License-Identifier: Apache-2.0
"""Learn the image likelihood of body parts from annotated images."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.image.contour import CELL_METRES, LEVELS
from flowing_puppet_ros.evidence.image.likelihood import TERMS_OF
from flowing_puppet_ros.learn.annotations import add_annotation_arguments, load_annotations
from flowing_puppet_ros.learn.likelihood.samples import pose_people
from flowing_puppet_ros.learn.likelihood.training import LearnedLikelihood, LikelihoodSettings, learn_likelihood
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.process.threads import one_blas_thread
from flowing_puppet_ros.settings import make_out_folder

PARTS = 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `learn likelihood`."""
    add_annotation_arguments(parser)
    parser.add_argument("--out", type=Path, required=True, help="folder for likelihood_10.npz and its model card")
    LikelihoodSettings.add_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Learn the likelihood, write it with its card and print its path; progress on stderr."""
    settings = LikelihoodSettings.from_arguments(arguments)
    annotations = load_annotations(arguments)
    make_out_folder(arguments.out)
    model = DeformableStructures.load("neutral", PARTS)
    people = list(pose_people(annotations, model, settings.every))
    if not people:
        raise InputError(f"{arguments.annotations} has no person whose joints determine a scale; annotate some first")
    # Sums depend on the number of BLAS threads; with one thread the weights are the same on every machine.
    with one_blas_thread():
        learned = learn_likelihood(model, people, settings, lambda step: print(step, file=sys.stderr))
    path = arguments.out / f"likelihood_{PARTS}.npz"
    np.savez_compressed(path, **learned.likelihood.to_arrays())  # type: ignore[arg-type]
    files = len({posed.file for posed in people})
    card = format_card(settings, learned, len(people), files, arguments.leave_out is not None)
    path.with_suffix(".md").write_text(card, encoding="utf-8")
    print(path)
    return 0


def format_card(
    settings: LikelihoodSettings, learned: LearnedLikelihood, people: int, files: int, left_out: bool
) -> str:
    """Describe the likelihood, its training data and the weights of its terms."""
    rows = [
        f"| {kind} | {learned.counts[kind]} | "
        + ", ".join(f"{term} {weight:.2f}" for term, weight in zip(TERMS_OF[kind], weights, strict=True))
        + " |"
        for kind, weights in learned.likelihood.terms.items()
    ]
    return _CARD.format(
        settings=settings,
        command=f"flowing-puppet learn likelihood ANNOTATIONS.json{' --leave-out TEST.json' if left_out else ''}"
        f" --every {settings.every} --wrong {settings.wrong} --regularisation {settings.regularisation:g}"
        f" --seed {settings.seed} --out flowing_puppet_ros/weights",
        rows="\n".join(rows),
        people=people,
        files=files,
        cells=", ".join(f"{100 * CELL_METRES * 2**level:g}" for level in range(LEVELS)),
        parts=PARTS,
    )


_CARD = """# Likelihood of the parts of a puppet of {parts} parts

How right and wrong contours of body parts look in images (S. Zuffi, thesis, "Human Pose Estimation from Single
Images", Eqs. 20 to 22), and how skin looks. For each kind of part: a linear SVM over steered HOG descriptors inside, on
and outside the contour, with cells of {cells} cm, its calibration, and the weights of the terms. One for all genders;
left and right limbs share a filter, whose points run the other way round.

- Learned from {people} people in {files} files with the command
  `{command}`
- Annotations that the shipped file was learned from: joints that a network (MediaPipe Pose 0.10.21) marked on 118 JHMDB
  clips, so they are off by some pixels; clips of the people and source videos that it is tested on were left out. No
  frame and no joint is in this file, only filters, weights and one histogram of colours.
- Right contours are those of the neutral puppet on the joints; for each {settings.wrong} wrong ones: turned, moved and
  stretched, a quarter of them anywhere near the person. Calibration and weights are of examples whose filter had not
  seen their source video.
- Differences from the thesis: descriptors are Fourier coefficients of orientation histograms, which turn exactly; cells
  are of fixed size on the body; a* and b* also for skin; colour terms also against a band around the part; the weights
  of the terms are learned by logistic regression, not by grid search.

| part | right examples (with mirror images where a part has no side) | weights of the terms |
|---|---|---|
{rows}

- Limits: upper bodies, mostly seen from the front, in films and web videos of 320 by 240 pixels; no filters for legs,
  which therefore weigh nothing; light skin is more frequent than dark in the clips, which the colours of the face make
  up for only once the head is found.
- Licence: Apache-2.0, as the package.
"""
