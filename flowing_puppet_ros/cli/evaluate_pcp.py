# SPDX-License-Identifier: Apache-2.0
"""Percentage of correct parts (PCP) of poses, or of every method on a folder of images (thesis, Table 1).

INPUT is a poses.json of `pose`, or a folder of images: then the detector alone, NL (no likelihood), NS (no shape),
plain PMP and D-PMP are measured on it. The truth is the annotation tool's JSON, keypoints.json, or a text file of
sticks as of the Buffy Stickmen.
"""

from __future__ import annotations

import argparse
import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.pcp import PosedSticks, Tally
from flowing_puppet_ros.evaluate.pcp_methods import measure_methods
from flowing_puppet_ros.evaluate.pcp_truth import Truth, images_of, read_truth
from flowing_puppet_ros.evidence.likelihood import PartLikelihood
from flowing_puppet_ros.image.detector import PartDetector
from flowing_puppet_ros.image.pose_settings import PoseSettings
from flowing_puppet_ros.image.sticks import sticks_of
from flowing_puppet_ros.model.ds import DeformableStructures
from flowing_puppet_ros.model.ds_multiview import MultiViewStructures
from flowing_puppet_ros.settings import make_out_folder

SWITCHES = ("likelihood", "shape", "diverse")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of `evaluate pcp`."""
    parser.add_argument("input", type=Path, help="folder of images, or poses.json")
    parser.add_argument(
        "--truth", type=Path, help="annotations.json, keypoints.json or sticks.txt [INPUT/annotations.json]"
    )
    parser.add_argument("--out", type=Path, help="folder for pcp.json and pcp.csv")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--model", default="neutral", choices=("neutral", "female", "male"), help="body [neutral]")
    parser.add_argument("--pixels", type=float, default=20.0, help="distance for elbows and wrists, px [20]")
    PoseSettings.add_arguments(parser, skip=SWITCHES)


def run(arguments: argparse.Namespace) -> int:
    """Measure, print the table or JSON, and write the files."""
    folder = arguments.input if arguments.input.is_dir() else None
    path = arguments.truth or (None if folder is None else folder / "annotations.json")
    if path is None:
        raise InputError(f"{arguments.input} needs the truth: name it with --truth")
    if not arguments.pixels > 0:
        raise InputError(f"--pixels is {arguments.pixels}; it must be positive")
    truth = read_truth(path)
    if not any(truth.values()):
        raise InputError(f"{path} has no person in any image")
    if arguments.out is not None:
        make_out_folder(arguments.out)
    figures = _of_poses(arguments, truth) if folder is None else _of_images(arguments, folder, truth)
    if arguments.out is not None:
        (arguments.out / "pcp.json").write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
        _write_csv(arguments.out / "pcp.csv", figures)
    print(json.dumps(figures) if arguments.json else table(figures))
    return 0


def _of_images(arguments: argparse.Namespace, folder: Path, truth: Truth) -> dict[str, dict[str, float]]:
    settings = PoseSettings.from_arguments(arguments)
    images = ((frame.image, people) for frame, people in images_of(folder, truth))
    with tqdm(total=sum(bool(people) for people in truth.values()), unit="image", disable=None) as progress:
        return measure_methods(
            images,
            DeformableStructures.load(arguments.model),
            MultiViewStructures.load(arguments.model),
            PartDetector.load(),
            PartLikelihood.load(),
            settings,
            arguments.pixels,
            lambda: progress.update() and None,
        )


def _of_poses(arguments: argparse.Namespace, truth: Truth) -> dict[str, dict[str, float]]:
    """Figures of a file of poses; an image is known by its place, its path or the number in its name."""
    try:
        data = json.loads(arguments.input.read_text(encoding="utf-8"))
        names = tuple(data["joint_names"])
        frames = [(frame["index"], frame.get("path", ""), _people(names, frame["puppets"])) for frame in data["frames"]]
    except OSError as error:
        raise InputError(f"{arguments.input} cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{arguments.input} is no file of poses ({error!r})") from error
    tally = Tally(arguments.pixels)
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
        raise InputError(f"no image of {arguments.input} is one of the truth's")
    return {str(arguments.input): tally.figures()}


def _people(names: tuple[str, ...], puppets: list[dict[str, Any]]) -> list[PosedSticks]:
    people = []
    for puppet in puppets:
        sticks = sticks_of(names, np.array(puppet["joints"], np.float64)[:, :2])
        others = [sticks_of(names, np.array(one["joints"], np.float64)) for one in puppet.get("solutions", [])]
        people.append(PosedSticks(sticks, np.stack([sticks, *others])))
    return people


def _write_csv(path: Path, figures: dict[str, dict[str, float]]) -> None:
    columns = list(dict.fromkeys(name for row in figures.values() for name in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["method", *columns])
        writer.writerows([method, *(row.get(name, "") for name in columns)] for method, row in figures.items())


def table(figures: dict[str, dict[str, float]]) -> str:
    """Figures as text, a line a figure and a column a method."""
    rows = list(dict.fromkeys(name for row in figures.values() for name in row))
    first = max(len(name) for name in rows)
    lines = [" " * first + "".join(f"  {method:>10}" for method in figures)]
    for name in rows:
        values = (f"{row[name]:g}" if name in row else "" for row in figures.values())
        lines.append(
            name.ljust(first)
            + "".join(f"  {value:>{max(10, len(m))}}" for value, m in zip(values, figures, strict=True))
        )
    return "\n".join(lines)
