# SPDX-License-Identifier: Apache-2.0
"""What the verb `import` does."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from flowing_puppet_ros.bag.cameras.first_look import look_at_people
from flowing_puppet_ros.bag.cameras.import_folder import write_camera_bag
from flowing_puppet_ros.bag.cameras.sources import CameraSource, add_keypoints, find_sources, match_names
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.networks.choice import load_networks
from flowing_puppet_ros.multiview.bundle.world import settle_world
from flowing_puppet_ros.multiview.rig.files import read_rig
from flowing_puppet_ros.multiview.rig.rig import CameraRig
from flowing_puppet_ros.multiview.rig.video_size import fit_to_video

_SAME_LENGTH_S = 0.1  # by which videos may end earlier or later than one another without a word
_SAME_RATE = 0.01


def run(arguments: argparse.Namespace) -> int:
    """Import the folder."""
    began = time.monotonic()
    notes: list[str] = []

    def note(sentence: str) -> None:
        if sentence not in notes:
            notes.append(sentence)
            print(f"flowing-puppet import: {sentence}", file=sys.stderr)

    for value, flag in ((arguments.fps, "--fps"), (arguments.person_height, "--person-height")):
        if not (np.isfinite(value) and value >= 0):
            raise InputError(f"{flag} is {value:g}: give a positive number")
    rig = read_rig(arguments.calibration)
    sources = find_sources(arguments.folder, note, arguments.fps)
    names = match_names([source.name for source in sources], list(rig.cameras), note)
    place = arguments.keypoints or arguments.folder
    sources = [add_keypoints(source, place) for source in sources if source.name in names]
    _compare_videos(sources, note)
    rig = _fit_rig(rig, names, sources, _parse_crops(arguments.crop, list(names)), note)
    offsets = {name: each.time_offset for name, each in rig.cameras.items()}
    has_people = any(source.people is not None for source in sources)
    networks = None if has_people else load_networks("auto")
    joint_names, instants = look_at_people(sources, offsets, networks)
    rig = settle_world(rig, joint_names, instants, arguments.unit, arguments.up, arguments.person_height, note)
    cameras = {name: each.camera for name, each in rig.cameras.items()}
    counts = write_camera_bag(arguments.out, sources, cameras, offsets)
    summary = {
        "input": str(arguments.folder),
        "output": str(arguments.out),
        "cameras": list(cameras),
        "images": {name: counts[f"/{name}/image/compressed"] for name in cameras},
        "detections": {name: counts.get(f"/{name}/detections", 0) for name in cameras},
        "warnings": notes,
        "seconds": round(time.monotonic() - began, 3),
    }
    print(json.dumps(summary) if arguments.json else _text(summary))
    return 0


def _text(summary: dict[str, object]) -> str:
    images = summary["images"]
    assert isinstance(images, dict)
    listed = ", ".join(f"{name} {count}" for name, count in images.items())
    return f"{summary['output']}: images of {listed} in {summary['seconds']:.1f} s"


def _parse_crops(texts: Sequence[str], names: Sequence[str]) -> dict[str, tuple[float, float]]:
    found = {}
    for text in texts:
        name, _, values = text.partition("=")
        try:
            left, top = (float(value) for value in values.split(","))
        except ValueError as error:
            raise InputError(f"--crop is {text!r}: give CAMERA=LEFT,TOP in pixels, such as cam01=8,0") from error
        if name not in names:
            raise InputError(f"--crop names {name!r}, but the cameras are {', '.join(names)}")
        found[name] = left, top
    return found


def _fit_rig(
    rig: CameraRig,
    names: dict[str, str],
    sources: Sequence[CameraSource],
    crops: dict[str, tuple[float, float]],
    note: Callable[[str], None],
) -> CameraRig:
    """Return the cameras of the videos under the videos' names, each for the size of its frames."""
    found = {}
    for source in sources:
        size = source.frames.read_size(0)
        if size is None:
            raise InputError(f"the first image of {source.name} cannot be read")
        each = rig.cameras[names[source.name]]
        pixels = round(size[0]), round(size[1])
        camera = fit_to_video(source.name, each, pixels, crops.get(source.name), note)
        found[source.name] = replace(each, camera=camera)
    return CameraRig(found, rig.unit)


def _compare_videos(sources: Sequence[CameraSource], note: Callable[[str], None]) -> None:
    """Tell that videos have different rates or lengths: nothing is left out, but not every image has partners."""
    rates = {source.name: source.frames.fps for source in sources}
    if max(rates.values()) > (1 + _SAME_RATE) * min(rates.values()):
        listed = ", ".join(f"{name} {rate:g}" for name, rate in rates.items())
        note(f"the videos have different rates ({listed} images a second): people are in space where stamps meet")
    counts = {source.name: len(source.frames.files) or source.frames.count for source in sources}
    lengths = {name: count / rates[name] for name, count in counts.items() if count}
    if lengths and max(lengths.values()) - min(lengths.values()) > _SAME_LENGTH_S:
        listed = ", ".join(f"{name} {length:.2f} s" for name, length in lengths.items())
        note(f"the videos have different lengths ({listed}): all begin together and the longer ones go on alone")
