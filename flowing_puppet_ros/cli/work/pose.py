# SPDX-License-Identifier: Apache-2.0
"""What the verb `pose` does."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from flowing_puppet_ros.cli.work.settings import GENDERS, PoseVerbSettings
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.image.likelihood import PartLikelihood
from flowing_puppet_ros.image.detector.detection import PersonDetection
from flowing_puppet_ros.image.detector.part_detector import PartDetector
from flowing_puppet_ros.image.formats.frame_names import FrameNames
from flowing_puppet_ros.image.formats.keypoint_files import read_keypoints
from flowing_puppet_ros.image.formats.tracks_json import DECIMALS, puppet_to_json, write_tracks
from flowing_puppet_ros.image.formats.video_reader import FOLDER_FPS, IMAGE_SUFFIXES, FrameSource, open_frames
from flowing_puppet_ros.image.networks.choice import load_networks
from flowing_puppet_ros.image.networks.sources import IMAGE_SIDE_PX, NOT_INSTALLED
from flowing_puppet_ros.image.pose.estimator import PoseEstimator
from flowing_puppet_ros.image.pose.result import PosedPuppet
from flowing_puppet_ros.image.settings import DetectorSettings
from flowing_puppet_ros.model.ds.multiview import MultiViewStructures
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.tree import PartTree
from flowing_puppet_ros.process.threads import one_opencv_thread


@one_opencv_thread()
def run(arguments: argparse.Namespace) -> int:
    """Pose the people of every image; return 1 if an image could not be read, after all others are done."""
    files = list(_find_images(arguments.images))
    source = FrameSource(Path(), FOLDER_FPS, len(files), tuple(files))
    init = None if arguments.init is None else read_keypoints(arguments.init, FrameNames.of(source))
    if arguments.out.resolve() in {file.resolve() for file in files} | {Path(arguments.init or "").resolve()}:
        raise InputError(f"{arguments.out} is an input itself: name another output")
    if init is not None and min(index for index, people in init.items() if people) >= len(files):
        raise InputError(f"{arguments.init} has no keypoints for any of the {len(files)} images; frames count from 0")
    genders = GENDERS if arguments.model == "auto" else (arguments.model,)
    models = [DeformableStructures.load(gender) for gender in genders]
    sides = [MultiViewStructures.load(gender) for gender in genders]
    # The search models upper bodies without separate hands; hands are drawn at the ends of the lower arms.
    drawn = [MultiViewStructures.load(gender, arguments.parts) for gender in genders] if arguments.parts > 10 else []
    settings = PoseVerbSettings.from_arguments(arguments)
    networks = load_networks(arguments.source, IMAGE_SIDE_PX, True, arguments.network) if init is None else None
    if init is None and networks is None and arguments.source == "auto":
        print(f"flowing-puppet pose: {NOT_INSTALLED}", file=sys.stderr)
    own = init is None and networks is None
    detector = _ConfiguredDetector(PartDetector.load(), settings.detector) if own else None
    estimator = PoseEstimator(models, detector, PartLikelihood.load(), settings.pose, sides, drawn)
    shown = drawn[0].views[0] if drawn else models[0]
    frames = []
    for index, file in enumerate(tqdm(files, unit="image", disable=None)):
        people = None if init is None else init.get(index, [])
        began = time.monotonic()
        try:
            (frame,) = open_frames(file)
            if networks is not None:
                people = [person.keypoints for person in networks.find(frame.image)]
            posed = estimator.estimate(frame.image, people)
        except InputError as error:
            if len(files) == 1:
                raise
            print(f"flowing-puppet pose: {error}", file=sys.stderr)
            continue
        puppets = [make_pose_entry(one, shown.tree) for one in posed]
        stamp = round(index * 1e9 / FOLDER_FPS)
        frames.append({"index": index, "path": str(file), "stamp_ns": stamp, "puppets": puppets})
        _print_result(arguments, file, posed, time.monotonic() - began)
    if not frames:
        raise InputError("none of the images can be used")
    write_tracks(arguments.out, shown.joint_names, FOLDER_FPS, frames)
    return 1 if len(frames) < len(files) else 0


@dataclass(frozen=True, slots=True, eq=False)
class _ConfiguredDetector:
    """The detector with the settings of the command line."""

    detector: PartDetector
    settings: DetectorSettings

    def detect(self, image: np.ndarray[Any, Any]) -> list[PersonDetection]:
        return self.detector.detect(image, self.settings)


def _find_images(paths: list[Path]) -> Iterator[Path]:
    """Yield the image files that the arguments name, folders in natural order."""
    for path in paths:
        source = open_frames(path) if path.is_dir() or path.suffix.lower() in IMAGE_SUFFIXES else None
        if source is None:
            reason = "is not an image" if path.is_file() else "does not exist"
            raise InputError(f"{path} {reason}; give image files or folders of images, and videos to `track`")
        yield from source.files


def make_pose_entry(posed: PosedPuppet, tree: PartTree) -> dict[str, Any]:
    """Make the JSON object of one person: a puppet as in tracks.json, its model, all solutions and their energies."""
    solutions = [
        {
            "energy": round(one.energy, 4),
            "scale": round(one.scale, DECIMALS),
            "joints": np.round(one.joints, DECIMALS).tolist(),
        }
        for one in posed.solutions
    ]
    genders = {name: round(value, 4) for name, value in posed.gender_probability.items()}
    extra = {"model": posed.model, "gender_probability": genders, "solutions": solutions}
    return puppet_to_json(posed, tree) | extra


def _print_result(arguments: argparse.Namespace, file: Path, posed: list[PosedPuppet], seconds: float) -> None:
    if not arguments.json:
        print(f"{file}: {len(posed)} {'person' if len(posed) == 1 else 'people'}, {seconds:.2f} s")
        return
    people = [{"id": one.id, "scale": round(one.scale, DECIMALS), "energy": round(one.energy, 4)} for one in posed]
    print(json.dumps({"input": str(file), "out": str(arguments.out), "puppets": people, "seconds": round(seconds, 3)}))
