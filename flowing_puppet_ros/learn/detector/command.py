# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet learn detector`: learn the detector of people from annotated images or videos, with its model card.

Annotations are those of `flowing-puppet annotate`, or lists of joints a video clip (see image/formats/annotations.py).
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from flowing_puppet_ros.learn.annotations import add_annotation_arguments, load_annotations
from flowing_puppet_ros.learn.detector.data import make_examples
from flowing_puppet_ros.learn.detector.training import (
    CALIBRATION_PEOPLE,
    LearnDetectorSettings,
    LearnedDetector,
    learn_detector,
)
from flowing_puppet_ros.process.threads import one_blas_thread
from flowing_puppet_ros.settings import make_out_folder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `learn detector`."""
    add_annotation_arguments(parser)
    parser.add_argument("--name", default="upper", help="name of the detector [%(default)s]")
    parser.add_argument("--out", type=Path, required=True, help="folder for detector_NAME.npz and its model card")
    LearnDetectorSettings.add_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Learn one detector, write it with its card and print its path; progress on stderr."""
    settings = LearnDetectorSettings.from_arguments(arguments)
    make_out_folder(arguments.out)
    annotations = load_annotations(arguments)
    began = time.process_time()
    # Sums depend on the number of BLAS threads; with one thread the weights are the same on every machine.
    with one_blas_thread():
        examples = make_examples(annotations.read_frames(settings.every))
        learned = learn_detector(examples, settings, lambda step: print(step, file=sys.stderr))
    path = arguments.out / f"detector_{arguments.name}.npz"
    np.savez_compressed(path, **learned.detector.to_arrays())  # type: ignore[arg-type]
    card = format_card(arguments, settings, learned, len(annotations.people), time.process_time() - began)
    path.with_suffix(".md").write_text(card, encoding="utf-8")
    print(path)
    return 0


def format_card(
    arguments: argparse.Namespace, settings: LearnDetectorSettings, learned: LearnedDetector, files: int, seconds: float
) -> str:
    """Describe the detector, its training data, its accuracy and its limits."""
    left_out = f" --leave-out {arguments.leave_out.name}" if arguments.leave_out else ""
    return _CARD.format(
        name=arguments.name,
        people=learned.people,
        files=files,
        command=f"flowing-puppet learn detector {arguments.annotations.name}{left_out} --every {settings.every} "
        f"--steps {settings.steps} --trees {settings.trees} --held-out {settings.held_out} --seed {settings.seed} "
        "--out FOLDER",
        minutes=seconds / 60,
        held_out=learned.held_out,
        ranked=min(CALIBRATION_PEOPLE, learned.held_out),
        found=100 * learned.found,
        filters=len(learned.detector.parts.filters),
        trees=len(learned.detector.trees.leaves),
    )


_CARD = """# Detector {name}

Finds people in one image and tells eleven joints of the upper body: rigid head-and-shoulders filters and {trees}
boosted trees for place and scale, {filters} jointly learned part filters on HOG and colour (a tree of 15 parts,
mixtures by the orientation of the limbs, quadratic springs, exact dynamic programming) for the pose, logistic
regression for the confidence. No neural network.

- Learned from {people} people in {files} annotated videos or images, each also mirrored, blurred and relit, in
  {minutes:.0f} minutes of one processor core, with the command
  `{command}`
- Only statistics of the images are in the file, no image.
- Calibrated on people of other videos than the filters were learned on ({held_out}, of whom about {ranked} are looked
  at): there the surest pose has the right place (half a shoulder width) and scale (25 %) in {found:.0f} % of the
  images.
- Limits: upright people, seen from the front or half from the side, shoulders at least a twentieth of the image's
  longer side wide; no knees and ankles; arms in front of the face, and people seen from the side, are often missed.
- Licence: Apache-2.0, as the package.
"""
