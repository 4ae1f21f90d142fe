# SPDX-License-Identifier: Apache-2.0
"""True sticks of people by image, from the annotation tool, from keypoints or from Buffy Stickmen text files.

annotations.json  {"joint_names": [...], "images": {"a/b.png" or "clip.avi#12": [{"joints": [[x, y, visible], ...]}]}}
keypoints.json    {"joint_names": [...], "frames": {"0": [[[x, y, confidence], ...], ...]}}
sticks.txt        frame number and 6 x (x1 y1 x2 y2) a person, see image.sticks
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

type Truth = Mapping[str | int, Sequence[Array]]
"""Sticks (6,2,2) of the people of an image, by its key in annotations.json or by its number."""


def read_truth(path: Path) -> Truth:
    """Read one of the three forms; InputError with the reason when it is none of them."""
    if path.suffix.lower() == ".json":
        return _annotations(path) or {
            number: [_person_sticks(one) for one in people] for number, people in read_keypoints(path).items()
        }
    return dict(read_sticks(path).items())


def _annotations(path: Path) -> Truth | None:
    """The people of annotations.json; None when it is no such file."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if "images" not in data:
            return None
        names = tuple(data["joint_names"])
        return {
            key: [_annotated_sticks(names, np.array(person["joints"], np.float64)) for person in people]
            for key, people in data["images"].items()
        }
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path} is no file of annotations or keypoints ({error!r})") from error


def _annotated_sticks(names: Sequence[str], joints: Array) -> Array:
    return sticks_from_joints(names, np.where(joints[:, 2:] > 0, joints[:, :2], np.nan))


def _person_sticks(person: Keypoints) -> Array:
    """Sticks of the keypoints as they are; joints that are not named among them are unknown."""
    found = person.usable()
    nowhere = (np.nan, np.nan, 0.0)
    names = JOINT_NAMES[10]
    return sticks_from_joints(names, np.array([found.get(name, nowhere)[:2] for name in names]))


def images_of(folder: Path, truth: Truth) -> Iterator[tuple[VideoFrame, Sequence[Array]]]:
    """The images below `folder` that have people in `truth`, with their people, in the order of the truth.

    A number is that in the name of an image, or the image's place in the folder when names have none or share them.
    """
    numbered = _numbered(folder) if any(isinstance(key, int) for key in truth) else {}
    clip: tuple[str, dict[int, VideoFrame]] = ("", {})
    for key, people in truth.items():
        if not people:
            continue
        if isinstance(key, int):
            if key not in numbered:
                raise InputError(f"{folder} has no image number {key}, of which the truth speaks")
            yield _only(numbered[key]), people
            continue
        name, mark, number = key.rpartition("#")
        if not (mark and number.isdecimal()):
            yield _only(folder / key), people
            continue
        if clip[0] != name:
            wanted = {int(k.rpartition("#")[2]) for k in truth if isinstance(k, str) and k.startswith(name + "#")}
            clip = name, {frame.index: frame for frame in open_frames(folder / name) if frame.index in wanted}
        if int(number) not in clip[1]:
            raise InputError(f"{folder / name} has no frame {number}, of which the truth speaks")
        yield clip[1][int(number)], people


def _only(path: Path) -> VideoFrame:
    (frame,) = open_frames(path)
    return frame


def _numbered(folder: Path) -> dict[int, Path]:
    files = open_frames(folder).files
    digits = [re.findall(r"\d+", file.stem) for file in files]
    numbers = [int(found[-1]) for found in digits if found]
    if len(set(numbers)) < len(files):
        numbers = list(range(len(files)))
    return dict(zip(numbers, files, strict=True))
