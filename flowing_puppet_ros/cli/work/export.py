# SPDX-License-Identifier: Apache-2.0
"""What the verb `export` does."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from flowing_puppet_ros.bag.storage.paths import is_bag
from flowing_puppet_ros.body.scans.scan_frame import parse_axis
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.exchange.files import write_people
from flowing_puppet_ros.exchange.motion import BodyMotion, read_fit
from flowing_puppet_ros.settings import make_out_folder


def run(arguments: argparse.Namespace) -> int:
    """Export every result and say where the files are."""
    make_out_folder(arguments.out)
    for source in arguments.inputs:
        people = _read(source, arguments)
        try:
            files = write_people(people, arguments.to, arguments.out)
        except OSError as error:
            raise PuppetError(f"{error.filename} cannot be written: {error.strerror}") from error
        if arguments.json:
            frames = {person.name: len(person.stamps_ns) for person in people}
            print(
                json.dumps({"input": str(source), "files": [str(file) for file in files], "frames": frames}), flush=True
            )
        else:
            print(f"{files[0]}{f' and {len(files) - 1} more' if len(files) > 1 else ''}", flush=True)
    return 0


def _read(source: Path, arguments: argparse.Namespace) -> list[BodyMotion]:
    up = None if arguments.up == "auto" else np.asarray(parse_axis(arguments.up))
    if not source.exists():
        raise InputError(f"{source} does not exist; give an .npz that `fit` wrote, or a recording that `replay` wrote")
    if not is_bag(source):
        return [read_fit(source, up)]
    # Only bags need the bag stack, which takes a while to import.
    from flowing_puppet_ros.exchange.bag_bodies import read_bag_bodies

    people = read_bag_bodies(source, up)
    chosen = [person for person in people if not arguments.id or person.identity in arguments.id]
    if not chosen:
        raise InputError(f"{source} has nobody called {', '.join(arguments.id)}, only {_list_names(people)}")
    return chosen


def _list_names(people: list[BodyMotion]) -> str:
    return ", ".join(sorted({person.identity for person in people}))
