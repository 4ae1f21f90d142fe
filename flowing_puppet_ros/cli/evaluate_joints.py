# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet evaluate joints`: accuracy of 2D joints against the threshold, from tracks.json or poses.json."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.tables import json_text, text_table, write_csv, write_json
from flowing_puppet_ros.evaluate.tracks import joint_misses, read_tracks
from flowing_puppet_ros.image.tracks import read_keypoints
from flowing_puppet_ros.settings import make_out_folder
from flowing_puppet_ros.view.page import page, paragraph
from flowing_puppet_ros.view.plots import Series, line_plot

CURVES = ("wrist", "elbow", "shoulder", "knee", "ankle", "hip")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `flowing-puppet evaluate joints`."""
    parser.add_argument("tracks", type=Path, metavar="TRACKS", help="tracks.json or poses.json")
    parser.add_argument("--truth", type=Path, required=True, metavar="FILE", help="keypoints.json with the true joints")
    parser.add_argument("--most", type=int, default=40, metavar="PX", help="largest threshold, pixels [%(default)s]")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for joints.html, joints.csv and joints.json")
    parser.add_argument("--json", action="store_true", help="print the figures as one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Measure, print the accuracy of each joint at some thresholds and return the exit status."""
    if arguments.most < 4:
        raise InputError(f"--most is {arguments.most}; give at least 4 pixels")
    misses = joint_misses(read_tracks(arguments.tracks), read_keypoints(arguments.truth))
    thresholds = np.arange(1, arguments.most + 1)
    accuracy = misses.accuracy(thresholds)
    shown = sorted({max(arguments.most * share // 8, 1) for share in (1, 2, 4, 8)})
    rows: list[dict[str, Any]] = [
        {"joint": name} | {f"{t}_px": float(curve[t - 1]) for t in shown} for name, curve in accuracy.items()
    ]
    if arguments.out is not None:
        make_out_folder(arguments.out)
        write_csv(arguments.out / "joints.csv", rows)
        curves = {name: curve.tolist() for name, curve in accuracy.items()}
        write_json(arguments.out / "joints.json", {"thresholds_px": thresholds.tolist(), "percent_within": curves})
        (arguments.out / "joints.html").write_text(_page(accuracy, thresholds), encoding="utf-8")
    print(json_text({str(row["joint"]): row for row in rows}) if arguments.json else text_table(rows))
    return 0


def _page(accuracy: dict[str, np.ndarray], thresholds: np.ndarray) -> str:
    lines = [Series("all", thresholds.astype(float), accuracy["all"])]
    for joint in CURVES:
        sides = [accuracy[f"{side}_{joint}"] for side in ("left", "right") if f"{side}_{joint}" in accuracy]
        if sides:
            lines.append(Series(f"{joint}s", thresholds.astype(float), np.mean(sides, axis=0)))
    plot = line_plot(lines, "accuracy of joints", "threshold, px", "joints within, %")
    lead = paragraph("Share of the true joints that were found within a threshold; a person nobody found is a miss.")
    return page("Accuracy of joints", lead, [("Accuracy against the threshold", plot)])
