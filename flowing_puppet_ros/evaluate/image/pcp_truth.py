# SPDX-License-Identifier: Apache-2.0
"""True sticks of people by image, from the annotation tool, from keypoints or from Buffy Stickmen text files.

annotations.json  {"joint_names": [...], "images": {"a/b.png" or "clip.avi#12": [{"joints": [[x, y, visible], ...]}]}}
keypoints.json    {"joint_names": [...], "frames": {"0": [[[x, y, confidence], ...], ...]}}
sticks.txt        frame number and 6 x (x1 y1 x2 y2) per person, see image.formats.stickmen
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.stickmen import read_sticks, sticks_from_joints
from flowing_puppet_ros.image.formats.tracks_json import read_keypoints
from flowing_puppet_ros.image.formats.video_reader import VideoFrame, open_frames
from flowing_puppet_ros.model.ds.joints import JOINT_NAMES

type StickTruth = Mapping[str | int, Sequence[Array]]
"""Sticks (6, 2, 2) px of the people of an image, by its key in annotations.json or by its number."""


def read_stick_truth(path: Path) -> StickTruth:
    """Read one of the three forms; InputError if it is none of them."""
    if path.suffix.lower() == ".json":
        return _read_annotations(path) or {
            number: [_sticks_from_keypoints(one) for one in people] for number, people in read_keypoints(path).items()
        }
    return dict(read_sticks(path).items())


def _read_annotations(path: Path) -> StickTruth | None:
    """Read the people of annotations.json; None if the file has no images."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if "images" not in data:
            return None
        names = tuple(data["joint_names"])
        return {
            key: [_sticks_from_annotation(names, np.array(person["joints"], np.float64)) for person in people]
            for key, people in data["images"].items()
        }
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
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
