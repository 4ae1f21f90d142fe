# SPDX-License-Identifier: Apache-2.0
"""True sticks of people by image, from the annotation tool, from keypoints or from Buffy Stickmen text files.

annotations.json  {"joint_names": [...], "images": {"a/b.png" or "clip.avi#12": [{"joints": [[x, y, visible], ...]}]}}
keypoints.json    {"joint_names": [...], "frames": {"0": [[[x, y, confidence], ...], ...]}}
sticks.txt        frame number and 6 x (x1 y1 x2 y2) per person, see image.formats.stickmen
others            files or folders of COCO, OpenPose, AlphaPose and MediaPipe, see image.formats.detector_json
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.frame_names import FrameNames, Label
from flowing_puppet_ros.image.formats.keypoint_files import load_json, read_keypoints, read_labelled
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.stickmen import read_sticks, sticks_from_joints
from flowing_puppet_ros.image.formats.video_reader import FOLDER_FPS, FrameSource, VideoFrame, open_frames
from flowing_puppet_ros.model.ds.joints import JOINT_NAMES

type StickTruth = Mapping[str | int, Sequence[Array]]
"""Sticks (6, 2, 2) px of the people of an image, by its key in annotations.json or by its number."""


def read_stick_truth(path: Path, source: Path) -> StickTruth:
    """Read any of these forms; `source` is the folder of images or the poses.json that it tells the truth about.

    InputError if it is none of them.
    """
    if path.is_dir():
        return _read_named(path, source)
    if path.suffix.lower() != ".json":
        return dict(read_sticks(path).items())
    data = load_json(path)
    if not isinstance(data, dict) or "joint_names" not in data:
        return _read_named(path, source)
    if "images" in data:
        return _read_annotations(data, path)
    people = read_labelled(path).people
    # In our own file a number is that in an image's name, see `open_true_images`.
    return _convert(people) if all(isinstance(label, int) for label in people) else _read_named(path, source)


def _convert(people: Mapping[Label, Sequence[Keypoints]]) -> StickTruth:
    return {number: [_sticks_from_keypoints(one) for one in found] for number, found in people.items()}


def _read_named(path: Path, source: Path) -> StickTruth:
    """Read the keypoints of another detector; its images are named, or are counted from 0 where it has no names."""
    files = open_frames(source).files if source.is_dir() else _list_posed(source)
    frames = FrameNames(source.stem, files, len(files), FrameSource(source, FOLDER_FPS, len(files), files).read_size)
    people = read_keypoints(path, frames)
    # An image is known by its name in its folder, and by its whole path in a poses.json.
    keys = [file.name if source.is_dir() else file.as_posix() for file in files]
    return _convert({keys[index] if index < len(keys) else index: found for index, found in people.items()})


def _list_posed(source: Path) -> tuple[Path, ...]:
    """Return the images that a poses.json names; none if it has no names."""
    data = load_json(source)
    frames = data.get("frames", []) if isinstance(data, dict) else []
    paths = [frame.get("path") for frame in frames if isinstance(frame, dict)]
    return tuple(Path(str(path)) for path in paths) if all(paths) else ()


def _read_annotations(data: Mapping[str, Any], path: Path) -> StickTruth:
    """Return the people of annotations.json."""
    try:
        names = tuple(data["joint_names"])
        return {
            key: [_sticks_from_annotation(names, np.array(person["joints"], np.float64)) for person in people]
            for key, people in data["images"].items()
        }
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path} is not a file of annotations or keypoints ({error!r})") from error


def _sticks_from_annotation(names: Sequence[str], joints: Array) -> Array:
    return sticks_from_joints(names, np.where(joints[:, 2:] > 0, joints[:, :2], np.nan))


def _sticks_from_keypoints(person: Keypoints) -> Array:
    """Return the sticks of keypoints; joints that they do not name are unknown."""
    found = person.select_usable()
    nowhere = (np.nan, np.nan, 0.0)
    names = JOINT_NAMES[10]
    return sticks_from_joints(names, np.array([found.get(name, nowhere)[:2] for name in names]))


def open_true_images(folder: Path, truth: StickTruth) -> Iterator[tuple[VideoFrame, Sequence[Array]]]:
    """Yield the images below `folder` that have people in `truth`, with their people, in the order of the truth.

    A number is that in an image's name, or the image's index in the folder if names have no numbers or share them.
    """
    numbered = _number_images(folder) if any(isinstance(key, int) for key in truth) else {}
    clip: tuple[str, dict[int, VideoFrame]] = ("", {})
    for key, people in truth.items():
        if not people:
            continue
        if isinstance(key, int):
            if key not in numbered:
                raise InputError(f"{folder} has no image number {key}, which the truth names")
            yield _read_image(numbered[key]), people
            continue
        name, mark, number = key.rpartition("#")
        if not (mark and number.isdecimal()):
            yield _read_image(folder / key), people
            continue
        if clip[0] != name:
            wanted = {int(k.rpartition("#")[2]) for k in truth if isinstance(k, str) and k.startswith(name + "#")}
            clip = name, {frame.index: frame for frame in open_frames(folder / name) if frame.index in wanted}
        if int(number) not in clip[1]:
            raise InputError(f"{folder / name} has no frame {number}, which the truth names")
        yield clip[1][int(number)], people


def _read_image(path: Path) -> VideoFrame:
    (frame,) = open_frames(path)
    return frame


def _number_images(folder: Path) -> dict[int, Path]:
    files = open_frames(folder).files
    digits = [re.findall(r"\d+", file.stem) for file in files]
    numbers = [int(found[-1]) for found in digits if found]
    if len(set(numbers)) < len(files):
        numbers = list(range(len(files)))
    return dict(zip(numbers, files, strict=True))
