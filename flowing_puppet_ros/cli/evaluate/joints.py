# SPDX-License-Identifier: Apache-2.0
"""Accuracy of 2D joints and of people, from tracks.json or poses.json; several runs side by side.

Joints within a number of pixels and jitter; PCK@0.2 and PCKh@0.5; COCO's OKS AP and AR; people found, missed, and
reported twice or where nobody is.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.output import Chart, EvaluationReport, Line, name_runs
from flowing_puppet_ros.evaluate.output import add_arguments as add_output
from flowing_puppet_ros.evaluate.people import add_unmatched_argument
from flowing_puppet_ros.evaluate.video.tracks import (
    JointMisses,
    count_by_image,
    measure_misses,
    measure_people,
    read_tracks,
)
from flowing_puppet_ros.image.formats.keypoint_files import read_labelled

DRAWN_GROUPS = ("wrists", "elbows", "all joints")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `flowing-puppet evaluate joints`."""
    parser.add_argument("tracks", nargs="+", type=Path, metavar="TRACKS", help="tracks.json or poses.json of a run")
    parser.add_argument(
        "--truth",
        type=Path,
        required=True,
        metavar="FILE",
        help="the true joints: keypoints.json, or keypoints in pixels of COCO, OpenPose, AlphaPose or MediaPipe",
    )
    parser.add_argument("--most", type=int, default=40, metavar="PX", help="largest threshold, pixels [%(default)s]")
    add_unmatched_argument(parser)
    add_output(parser, "joints")


def run(arguments: argparse.Namespace) -> int:
    """Measure, print accuracy at some thresholds, median and jitter of every run, and return the exit status."""
    if arguments.most < 4:
        raise InputError(f"--most is {arguments.most}; give at least 4 pixels")
    names = name_runs(arguments.tracks)
    labelled = read_labelled(arguments.truth)
    if labelled.normalised:
        raise InputError(f"{arguments.truth} has shares of the image, not pixels; the images' size is not known here")
    named = labelled.people
    thresholds = np.arange(1, arguments.most + 1)
    shown = sorted({max(arguments.most * share // 8, 1) for share in (1, 2, 4, 8)})
    figures, curves, images, lines = {}, {}, {}, []
    for name, path in zip(names, arguments.tracks, strict=True):
        tracks = read_tracks(path)
        truth = tracks.number(named)
        misses = measure_misses(tracks.frames, truth, () if any(tracks.frames.values()) else tracks.names)
        figures[name] = _summarise(misses, shown) | {"jitter, px": tracks.jitter()} | misses.pck()
        figures[name] |= measure_people(tracks, truth, arguments.unmatched)
        curves[name] = {joint: curve.tolist() for joint, curve in misses.accuracy(thresholds).items()}
        images[name] = count_by_image(tracks, named)
        lines += [
            Line(group, thresholds, 100 * (values[:, None] <= thresholds).mean(axis=0), name if len(names) > 1 else "")
            for group, values in misses.group().items()
            if group in DRAWN_GROUPS
        ]
    title = "Accuracy of joints; people nobody found are misses"
    chart = Chart("accuracy", title, "threshold, px", "joints within, %", lines, y_limits=(0, 100))
    details = {"thresholds_px": thresholds.tolist(), "percent_within": curves, "images": images}
    EvaluationReport("joints", figures, details, [chart]).emit(arguments)
    return 0


def _summarise(misses: JointMisses, thresholds: list[int]) -> dict[str, float]:
    figures = {}
    for group, values in misses.group().items():
        for threshold in thresholds:
            figures[f"{group} within {threshold} px, %"] = 100 * float(np.mean(values <= threshold))
        # A distance and a miss cannot be interpolated; a missed median joint makes the median a miss.
        figures[f"{group}, median px"] = float(np.quantile(values, 0.5, method="higher"))
    return figures
