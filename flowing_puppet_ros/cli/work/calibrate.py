# SPDX-License-Identifier: Apache-2.0
"""What the verb `calibrate` does."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from tqdm import tqdm

from flowing_puppet_ros.bag.cameras.recorded_rig import read_people, read_recorded_rig
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.networks.choice import load_networks
from flowing_puppet_ros.image.video.clip import DetectedFrame
from flowing_puppet_ros.multiview.bundle.adjustment import Freedom
from flowing_puppet_ros.multiview.bundle.calibrate import AGREE_M, Agreement, RefinedRig, Scale, refine_rig
from flowing_puppet_ros.multiview.rig.files import write_rig
from flowing_puppet_ros.multiview.rig.rig import CameraRig
from flowing_puppet_ros.process.threads import one_blas_thread, one_opencv_thread


@one_opencv_thread()
@one_blas_thread()
def run(arguments: argparse.Namespace) -> int:
    """Calibrate."""
    began = time.monotonic()
    notes: list[str] = []

    def warn(sentence: str) -> None:
        if sentence not in notes:
            notes.append(sentence)
            print(f"flowing-puppet calibrate: {sentence}", file=sys.stderr)

    def progress(frames: Iterable[DetectedFrame], title: str) -> Iterable[DetectedFrame]:
        return tqdm(frames, title, unit="frame", disable=None)

    scale = _parse_scale(arguments)
    if not (np.isfinite(arguments.max_offset) and arguments.max_offset >= 0):
        raise InputError(f"--max-offset is {arguments.max_offset:g}: give seconds")
    recorded = read_recorded_rig(arguments.bag, warn)
    names, frames = read_people(arguments.bag, recorded, load_networks(arguments.source), warn, progress)
    cameras = {name: each.camera for name, each in recorded.rig.cameras.items()}
    freedom = Freedom(not arguments.no_clocks, arguments.intrinsics)
    refined = refine_rig(names, cameras, frames, freedom, scale, arguments.max_offset)
    found = {
        name: replace(each, camera=refined.cameras[name], time_offset=refined.offsets[name])
        for name, each in recorded.rig.cameras.items()
    }
    write_rig(CameraRig(found, "m"), arguments.out, arguments.form)
    summary = _describe(arguments, refined, notes, time.monotonic() - began)
    print(json.dumps(summary) if arguments.json else _text(summary))
    return 0


def _parse_scale(arguments: argparse.Namespace) -> Scale:
    if not (np.isfinite(arguments.person_height) and arguments.person_height >= 0):
        raise InputError(f"--person-height is {arguments.person_height:g}: give metres")
    if not arguments.distance:
        return Scale(height=arguments.person_height)
    parts = arguments.distance.split(",")
    try:
        metres = float(parts[-1])
    except ValueError:
        metres = np.nan
    if len(parts) != 3 or not metres > 0:
        raise InputError(f"--distance is {arguments.distance!r}: give CAMERA,CAMERA,M, such as cam01,cam02,2.5")
    return Scale((parts[0], parts[1]), metres)


def _describe(arguments: argparse.Namespace, refined: RefinedRig, notes: list[str], seconds: float) -> dict[str, Any]:
    return {
        "input": str(arguments.bag),
        "output": str(arguments.out),
        "before_px": _round(refined.before),
        "after_px": _round(refined.after),
        "offsets_s": {name: round(offset, 5) for name, offset in refined.offsets.items()},
        "offsets_images": {name: round(offset / refined.period, 2) for name, offset in refined.offsets.items()},
        "person_heights_m": {person: round(height, 3) for person, height in refined.heights.items()},
        "known_to": {
            name: {"turn_deg": round(each.turn, 3), "roll_deg": round(each.roll, 3), "place_m": round(each.move, 4)}
            for name, each in refined.uncertainty.items()
        },
        "warnings": notes,
        "seconds": round(seconds, 3),
    }


def _round(agreement: Agreement) -> dict[str, Any]:
    return {
        "mean": round(agreement.all_mean, 2),
        "median": round(agreement.all_median, 2),
        "mean_where_they_agree": round(agreement.agreeing_mean, 2),
        "share_that_agrees": round(agreement.agreeing_share, 4),
        "mean_by_camera": {name: round(value, 2) for name, value in agreement.mean.items()},
        "median_by_camera": {name: round(value, 2) for name, value in agreement.median.items()},
    }


def _text(summary: dict[str, Any]) -> str:
    before, after = summary["before_px"], summary["after_px"]
    lines = ["camera        before px  after px  clock s  known to no better than (mean reprojection of joints)"]
    for name, value in after["mean_by_camera"].items():
        known = summary["known_to"][name]
        lines.append(
            f"{name:<12} {before['mean_by_camera'].get(name, np.nan):10.1f} {value:9.1f} "
            f"{summary['offsets_s'][name]:8.4f}  {known['turn_deg']:.2f} deg, roll {known['roll_deg']:.2f} deg, "
            f"{100 * known['place_m']:.1f} cm"
        )
    lines.append(
        f"all: mean {before['mean']:.1f} -> {after['mean']:.1f} px, "
        f"median {before['median']:.1f} -> {after['median']:.1f} px"
    )
    lines.append(
        f"joints on which cameras agree within {100 * AGREE_M:.0f} cm: {100 * before['share_that_agrees']:.0f} % -> "
        f"{100 * after['share_that_agrees']:.0f} %, their mean {before['mean_where_they_agree']:.1f} -> "
        f"{after['mean_where_they_agree']:.1f} px"
    )
    heights = ", ".join(f"{person} {height:.2f} m" for person, height in summary["person_heights_m"].items())
    return "\n".join([*lines, f"people: {heights or 'none measured'}", f"calibration: {summary['output']}"])
