# SPDX-License-Identifier: Apache-2.0
"""Run the nodes' algorithms over a recording: every message, in log order, with the same result every time.

Each camera (a topic named image, with its camera_info and, if there are any, detections) is tracked; three or more
calibrated cameras give a visual hull; hulls and point clouds are fitted with bodies. All results go into one bag with
the stamps of the input, and so do camera_info, detections and /tf_static.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from flowing_puppet_ros.bag.replay import ReplayOptions, replay
from flowing_puppet_ros.errors import InputError

_OF_NODES_ONLY = ("queue", "autostart", "use_sim_time")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `replay`."""
    parser.add_argument("input", type=Path, help="bag: .mcap, .db3 or a rosbag2 folder")
    parser.add_argument("--out", type=Path, required=True, help="output bag: a .mcap file, or a folder with metadata")
    parser.add_argument("--rate", type=float, default=0.0, help="times the recording's speed; 0 is full speed [0]")
    parser.add_argument(
        "--topic-map", action="append", default=[], metavar="OLD:=NEW", help="rename a topic of the input (repeatable)"
    )
    parser.add_argument("--params", type=Path, help="YAML file with the parameters of the nodes")
    parser.add_argument("--seed", type=int, default=0, help="seed of everything random [0]")
    parser.add_argument("--salvage", action="store_true", help="read what is whole of a truncated or damaged .mcap")
    parser.add_argument("--report", type=Path, metavar="HTML", help="write a report with pictures and figures")
    parser.add_argument("--json", action="store_true", help="print the summary as one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Replay, report, and say where the results are."""
    if not arguments.rate >= 0:
        raise InputError(f"--rate is {arguments.rate:g}: give 0 for full speed or a positive factor")
    if arguments.seed < 0:
        raise InputError(f"--seed is {arguments.seed}: give 0 or a positive number")
    options = ReplayOptions(
        rate=arguments.rate,
        topic_map=parse_topic_map(arguments.topic_map),
        settings=read_params(arguments.params) if arguments.params else {},
        seed=arguments.seed,
        salvage=arguments.salvage,
    )
    summary = replay(arguments.input, arguments.out, options)
    for warning in summary["warnings"]:
        print(f"flowing-puppet replay: {warning}", file=sys.stderr)
    try:
        if arguments.report:
            from flowing_puppet_ros.view.report import write_report

            write_report(arguments.input, arguments.out, arguments.report, summary)
            summary["report"] = str(arguments.report)
    finally:
        # The output bag is there, whatever becomes of the report.
        print(json.dumps(summary) if arguments.json else _text(summary))
    return 0


def parse_topic_map(rules: list[str]) -> dict[str, str]:
    """Return old name -> new name of rules like /camera/rgb:=/cam/image; InputError for anything else."""
    found = {}
    for rule in rules:
        old, separator, new = rule.partition(":=")
        if not separator or not old.startswith("/") or not new.startswith("/"):
            raise InputError(f"--topic-map is {rule!r}: give /old:=/new")
        found[old] = new
    return found


def read_params(path: Path) -> dict[str, dict[str, Any]]:
    """Return component -> settings of a ROS parameter file (`name: ros__parameters: ...`)."""
    try:
        content = YAML(typ="safe").load(path.read_text("utf8")) or {}
    except (OSError, UnicodeDecodeError, YAMLError) as error:
        raise InputError(f"the parameter file {path} cannot be read as YAML") from error
    found = {}
    for name, entry in content.items() if isinstance(content, dict) else [("", None)]:
        values = entry.get("ros__parameters") if isinstance(entry, dict) else None
        if not isinstance(values, dict):
            raise InputError(f"the parameter file {path} has no ros__parameters under {str(name)!r}")
        settings = {str(key): value for key, value in values.items() if key not in _OF_NODES_ONLY}
        found[str(name).rpartition("/")[2]] = settings
    return found


def _text(summary: dict[str, Any]) -> str:
    lines = [
        f"{summary['frames']} images and {summary['bodies']} bodies in {summary['seconds']:.1f} s "
        f"({summary['frames_per_second']:.1f} images a second)",
        f"results: {summary['output']}",
    ]
    if "report" in summary:
        lines.append(f"report: {summary['report']}")
    return "\n".join(lines)
