# SPDX-License-Identifier: Apache-2.0
"""Learn the detectors of hands from videos with annotated wrists."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from flowing_puppet_ros.evidence.image.hands import ACROSS, ALONG, CELL_METRES, HandDetectors
from flowing_puppet_ros.learn.annotations import add_annotation_arguments, load_annotations
from flowing_puppet_ros.learn.likelihood.samples import pose_people
from flowing_puppet_ros.learn.thesis_loop.hands import HandBoxes, HandSettings, learn_hands
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.process.threads import one_blas_thread
from flowing_puppet_ros.settings import make_out_folder

NAME = "upper"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `learn hands`."""
    add_annotation_arguments(parser)
    parser.add_argument("--out", type=Path, required=True, help=f"folder for hands_{NAME}.npz and its model card")
    HandSettings.add_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Learn the detectors, write them with their card and print the path; progress on stderr."""
    settings = HandSettings.from_arguments(arguments)
    annotations = load_annotations(arguments)
    make_out_folder(arguments.out)
    model = DeformableStructures.load()

    def say(step: str) -> None:
        print(step, file=sys.stderr)

    with one_blas_thread():
        learned, boxes = learn_hands(
            model, lambda: pose_people(annotations, model, settings.every, True), settings, say
        )
    path = arguments.out / f"hands_{NAME}.npz"
    np.savez_compressed(path, **learned.to_arrays())  # type: ignore[arg-type]
    card = format_card(settings, learned, boxes, len(annotations.people), arguments.leave_out is not None)
    path.with_suffix(".md").write_text(card, encoding="utf-8")
    print(path)
    return 0


def format_card(settings: HandSettings, learned: HandDetectors, boxes: HandBoxes, files: int, left_out: bool) -> str:
    """Describe the detectors, their training data and their weights."""
    image, flow, _ = learned.joint
    return _CARD.format(
        command=f"flowing-puppet learn hands ANNOTATIONS.json{' --leave-out TEST.json' if left_out else ''}"
        f" --every {settings.every} --wrong {settings.wrong} --regularisation {settings.regularisation:g}"
        f" --seed {settings.seed} --out flowing_puppet_ros/weights",
        along=len(ALONG),
        across=len(ACROSS),
        cell=100 * CELL_METRES,
        hands=int(boxes.right.sum()),
        wrong=int((~boxes.right).sum()),
        flows=int(boxes.flow.sum()),
        files=files,
        image=image,
        flow=flow,
    )


_CARD = """# Hands, by their look and by their motion

Two linear SVMs over boxes at the wrist that turn with the forearm (S. Zuffi, thesis, video chapter, "Image
Likelihood"): {along} by {across} cells of {cell:g} cm, each with a HOG descriptor. One reads the image, and the log
ratio of skin in each cell; the other the gradient magnitude of the optical flow that leads back in time, and how fast
each cell moves beside the background. Left and right hands share a filter.

- Learned from {hands} hands and {wrong} other places ({flows} boxes with flow) in {files} files with the command
  `{command}`
- Annotations that the shipped file was learned from: joints that a network (MediaPipe Pose 0.10.21) marked on 118 JHMDB
  clips; clips of the people and source videos that it is tested on were left out. No frame and no joint is in the file.
- Wrong places: random ones near the person, and those that the filters of a first round took for hands.
- The margins count {image:.2f} (image) and {flow:.2f} (flow) in the log odds of a hand, learned by logistic regression
  on boxes whose filter had not seen their half of the source videos.
- Differences from the thesis: descriptors are Fourier coefficients of orientation histograms, which turn exactly, so
  that one filter serves all orientations; speed beside the flow's gradient; one box serves both detectors.
- How well they tell hands: `flowing-puppet evaluate hands ANNOTATIONS.json`.
- Limits: people at rest give the flow detector nothing, and most hands rest most of the time.
- Licence: Apache-2.0, as the package.
"""
