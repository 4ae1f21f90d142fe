# SPDX-License-Identifier: Apache-2.0
"""Say what can be computed from an input, what is missing or wrong, and the command to run next.

INPUT is a bag, a scan, an image, a video, a file of keypoints, a folder of them, a fit, or `live`: the topics of the
running ROS graph. Without INPUT this machine is inspected: packages, extras, weights, ROS. Nothing is computed or
changed. The exit status is 1 where nothing can be computed from an input.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from flowing_puppet_ros.doctor.finding import Inspection
from flowing_puppet_ros.errors import InputError

LIVE = "live"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `doctor`."""
    parser.add_argument("inputs", nargs="*", metavar="INPUT", help="file, folder, or live [this machine]")
    parser.add_argument("--seconds", type=float, default=5.0, help="how long to listen to live topics [5]")
    parser.add_argument("--salvage", action="store_true", help="read what is whole of a truncated or damaged bag")
    parser.add_argument("--json", action="store_true", help="print one JSON object an input")


def run(arguments: argparse.Namespace) -> int:
    """Inspect every input and print what was found."""
    if not 0 < arguments.seconds <= 600:
        raise InputError(f"--seconds is {arguments.seconds:g}: give more than 0 and at most 600")
    status = 0
    for source in arguments.inputs or [""]:
        found = _inspect(source, arguments)
        print(json.dumps(found.to_json()) if arguments.json else _text(found), flush=True)
        status |= 0 if found.is_usable else 1
    return status


def _inspect(source: str, arguments: argparse.Namespace) -> Inspection:
    # Each of these imports much that the others do not need.
    if not source:
        from flowing_puppet_ros.doctor.machine import inspect_machine

        return inspect_machine()
    if source == LIVE and not Path(source).exists():
        return _inspect_live(arguments.seconds)
    from flowing_puppet_ros.doctor.inspect import inspect_input

    return inspect_input(Path(source), arguments.salvage)


def _inspect_live(seconds: float) -> Inspection:
    from flowing_puppet_ros.doctor.live import inspect_live

    try:
        from flowing_puppet_ros.node.live.listener import listen
    except ImportError as error:
        raise InputError(
            f"live topics need ROS 2, and there is no {error.name}: run `source /opt/ros/jazzy/setup.bash` first"
        ) from error
    return inspect_live(listen(seconds))


def _text(found: Inspection) -> str:
    lines = [f"{found.source}: {found.kind}" if found.kind != found.source else f"{found.source}:"]
    last = {finding.command: finding for finding in found.findings}
    for finding in found.findings:
        lines.append(f"  {finding.severity:<8} {finding.sentence}")
        if finding.command and last[finding.command] is finding:
            lines.append(f"           $ {finding.command}")
    return "\n".join(lines)
