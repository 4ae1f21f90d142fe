# SPDX-License-Identifier: Apache-2.0
"""Percentage of correct parts (PCP) and joints (PCK) of poses, or of every method on a folder (thesis, Table 1).

Each INPUT is a poses.json of `pose`, or a folder of images, on which the detector alone, NL (no likelihood), NS (no
shape), plain PMP and D-PMP are measured. Several inputs are shown side by side. The truth is the annotation tool's
JSON, keypoints.json, or a text file of sticks like those of the Buffy Stickmen. PCK and OKS AP are of the arms' joints.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.image.pcp import GROUPS, PosedSticks, Tally
from flowing_puppet_ros.evaluate.image.pcp_methods import measure_methods
from flowing_puppet_ros.evaluate.image.pcp_truth import StickTruth, open_true_images, read_stick_truth
from flowing_puppet_ros.evaluate.output import Chart, EvaluationReport, Figures, Line, name_runs
from flowing_puppet_ros.evaluate.output import add_arguments as add_output
from flowing_puppet_ros.evaluate.people import add_unmatched_argument
from flowing_puppet_ros.evaluate.video.tracks import read_score
from flowing_puppet_ros.evidence.image.likelihood import PartLikelihood
from flowing_puppet_ros.image.detector.part_detector import PartDetector
from flowing_puppet_ros.image.formats.stickmen import sticks_from_joints
from flowing_puppet_ros.image.pose.settings import PoseSettings
from flowing_puppet_ros.model.ds.multiview import MultiViewStructures
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

SWITCHES = ("likelihood", "shape", "diverse")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `evaluate pcp`."""
    parser.add_argument("inputs", nargs="+", type=Path, metavar="INPUT", help="folder of images, or poses.json")
    parser.add_argument(
        "--truth",
        type=Path,
        help="annotations.json, keypoints.json, sticks.txt, or keypoints of COCO, OpenPose, AlphaPose or MediaPipe "
        "[annotations.json in INPUT]",
    )
    add_unmatched_argument(parser)
    add_output(parser, "pcp")
    parser.add_argument("--model", default="neutral", choices=("neutral", "female", "male"), help="body [neutral]")
    parser.add_argument("--pixels", type=float, default=20.0, help="distance for elbows and wrists, px [20]")
    PoseSettings.add_arguments(parser, skip=SWITCHES)


def run(arguments: argparse.Namespace) -> int:
    """Measure, print the table or JSON, and write the files."""
    if not arguments.pixels > 0:
        raise InputError(f"--pixels is {arguments.pixels}; it must be positive")
    figures: Figures = {}
    for name, path in zip(name_runs(arguments.inputs), arguments.inputs, strict=True):
        truth = _read_truth(path, arguments.truth)
        if path.is_dir():
            methods = _measure_images(arguments, path, truth)
            figures |= {
                method if len(arguments.inputs) == 1 else f"{name} {method}": methods[method] for method in methods
            }
        else:
            figures[name] = _measure_poses(arguments, path, truth)
    EvaluationReport("pcp", figures, charts=[_make_chart(figures, rule) for rule in ("strict", "loose")]).emit(
        arguments
    )
    return 0


def _read_truth(source: Path, given: Path | None) -> StickTruth:
    path = given or (source / "annotations.json" if source.is_dir() else None)
    if path is None:
        raise InputError(f"{source} needs the truth: name it with --truth")
    truth = read_stick_truth(path, source)
    if not any(truth.values()):
        raise InputError(f"{path} has no person in any image")
    return truth


def _make_chart(figures: Figures, rule: str) -> Chart:
    groups = [group for group in GROUPS if any(f"{rule} {group}" in row for row in figures.values())]
    lines = [
        Line(run, np.arange(len(groups)), np.array([row.get(f"{rule} {group}", np.nan) for group in groups]))
        for run, row in figures.items()
    ]
    title = f"Percentage of correct parts, {rule}"
    return Chart(rule, title, "", "parts correct, %", lines, "bars", groups, (0, 100))


def _measure_images(arguments: argparse.Namespace, folder: Path, truth: StickTruth) -> Figures:
    settings = PoseSettings.from_arguments(arguments)
    images = ((frame.image, people) for frame, people in open_true_images(folder, truth))
    with tqdm(total=sum(bool(people) for people in truth.values()), unit="image", disable=None) as progress:
        return measure_methods(
            images,
            DeformableStructures.load(arguments.model),
            MultiViewStructures.load(arguments.model),
            PartDetector.load(),
            PartLikelihood.load(),
            settings,
            arguments.pixels,
            arguments.unmatched,
            lambda: progress.update() and None,
        )


def _measure_poses(arguments: argparse.Namespace, source: Path, truth: StickTruth) -> dict[str, float]:
    """Measure a file of poses; images are identified by index, path or the number in their names."""
    try:
        data = json.loads(source.read_text(encoding="utf-8"))
        names = tuple(data["joint_names"])
        frames = [
            (frame["index"], frame.get("path", ""), _read_people(names, frame["puppets"])) for frame in data["frames"]
        ]
    except OSError as error:
        raise InputError(f"{source} cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{source} is not a file of poses ({error!r})") from error
    tally = Tally(arguments.pixels, arguments.unmatched)
    matched = 0
    for key, people in truth.items():
        found = [
            posed
            for index, path, posed in frames
            if key == index or (path and Path(path).as_posix().endswith(str(key)))
        ]
        matched += bool(found)
        if people:
            tally.add(found[0] if found else [], people)
    if not matched:
        raise InputError(f"{source} and the truth have no image in common")
    return tally.summarise()


def _read_people(names: tuple[str, ...], puppets: list[dict[str, Any]]) -> list[PosedSticks]:
    people = []
    for puppet in puppets:
        joints = np.array(puppet["joints"], np.float64)
        sticks = sticks_from_joints(names, joints[:, :2])
        others = [sticks_from_joints(names, np.array(one["joints"], np.float64)) for one in puppet.get("solutions", [])]
        people.append(PosedSticks(sticks, np.stack([sticks, *others]), read_score(puppet)))
    return people
