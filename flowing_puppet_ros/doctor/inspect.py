# SPDX-License-Identifier: Apache-2.0
"""Inspect one input, whatever it is."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.replay.graph import Instance
from flowing_puppet_ros.doctor.files import inspect_file
from flowing_puppet_ros.doctor.finding import Inspection
from flowing_puppet_ros.doctor.recognise import Kind, make_command, recognise
from flowing_puppet_ros.doctor.recording import inspect_recording
from flowing_puppet_ros.errors import InputError


def inspect_input(path: Path, salvage: bool = False) -> Inspection:
    """Return what can be computed from a file or folder, what is missing, and the command to run next.

    `salvage` reads past the damage of a broken recording. What cannot be read is a finding of severity "error".
    InputError if there is nothing at the path.
    """
    if not path.exists():
        raise InputError(f"{path} does not exist; give a bag, scan, image, video or keypoint file, or a folder of them")
    kind = recognise(path)
    found = Inspection(str(path), kind)
    if kind is not Kind.BAG:
        inspect_file(path, kind, found)
        return found
    try:
        with open_bag(path, salvage) as bag:
            inspect_recording(bag, found, _BagAdvice(make_command(kind, path) + (" --salvage" if salvage else "")))
    except InputError as error:
        again = f"flowing-puppet doctor {shlex.quote(str(path))} --salvage" if "--salvage" in str(error) else ""
        found.add("error", str(error), again)
    return found


@dataclass(frozen=True, slots=True)
class _BagAdvice:
    """A recording is replayed as a whole, with its topics renamed if need be."""

    command: str

    def start(self, _: Instance) -> str:
        return self.command

    def rename(self, old: str, new: str) -> str:
        return f"{self.command} --topic-map {old}:={new}"
