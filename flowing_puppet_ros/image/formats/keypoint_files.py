# SPDX-License-Identifier: Apache-2.0
"""Read the people that any detector found from its file: ours, or one of those in `detector_json`, told by content.

    keypoints.json  {"joint_names": [...], "frames": {"0": [[[x, y, confidence], ...], ...]}}, people by a frame's index
                    or an image's name
    tracks.json     and poses.json, as `track` and `pose` write them
    sticks.txt      frame number and 6 x (x1 y1 x2 y2) per person, see `stickmen`
    a folder        of OpenPose's files or of landmarks, one a frame

Pixels of the input or, in other detectors' files, shares of its width and height. Person's left and right.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.detector_json import (
    FRAME_FORM,
    DetectorFrames,
    LabelledPeople,
    read_detector_frame,
    read_detector_json,
)
from flowing_puppet_ros.image.formats.frame_names import MAX_INDEX_DIGITS, FrameNames, Label, Size
from flowing_puppet_ros.image.formats.keypoints import Keypoints, normalise_name
from flowing_puppet_ros.image.formats.stick_regression import StickRegression
from flowing_puppet_ros.image.formats.stickmen import read_sticks
from flowing_puppet_ros.image.formats.video_reader import natural_sort_key
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

FRAME_FILE_ENDING = "_keypoints"  # of OpenPose's files, before .json
FORMS = (
    '{"joint_names": [...], "frames": {"0": [[[x, y, confidence], ...], ...]}}; '
    'COCO: {"images": [...], "annotations": [{"image_id", "keypoints": [x, y, v, ...]}]}; '
    'COCO results or AlphaPose: [{"image_id", "keypoints": [x, y, score, ...]}, ...]; '
    'OpenPose: {"people": [{"pose_keypoints_2d": [x, y, c, ...]}]}; '
    'MediaPipe: [{"landmarks": [{"x", "y", "visibility"}, ...]}, ...]'
)


def read_keypoints(path: str | Path, frames: FrameNames | None = None) -> dict[int, list[Keypoints]]:
    """Read people by frame index, px. No detector ran on a frame that is not listed.

    Frames that the file calls by name are found among `frames`; without them the number in the name is the index.
    InputError, naming the entry and the form expected, for any other file; when no frame or person is of these frames;
    when coordinates from 0 to 1 come without the size of the images.
    """
    return place_people(read_labelled(path), frames or FrameNames(), path)


def place_people(labelled: LabelledPeople, frames: FrameNames, place: str | Path) -> dict[int, list[Keypoints]]:
    """Return people by frame index, px; InputError as of `read_keypoints`, which begins with `place`."""
    found: dict[int, list[Keypoints]] = {}
    sizes: dict[int, Size | None] = {}
    for label, indices in frames.match(labelled.people, place).items():
        for index in indices:
            people = labelled.people[label]
            if labelled.normalised and people:
                size = labelled.sizes.get(label) or _find_size(frames, index, sizes, place)
                # A frame that cannot be read is not asked for its people.
                people = [_scale(one, size) for one in people] if size else []
            found.setdefault(index, []).extend(people)
    if not any(found.values()):
        raise InputError(f"{place} has no person in any frame")
    return found


def _find_size(frames: FrameNames, index: int, known: dict[int, Size | None], place: str | Path) -> Size | None:
    """Return the size of a frame; all of a video have the same."""
    if frames.read_size is None:
        raise InputError(
            f'{place} has coordinates from 0 to 1, which need the size of the images: add "width" and "height" in '
            "pixels to the file"
        )
    key = index if frames.files else 0
    if key not in known:
        known[key] = frames.read_size(key)
    return known[key]


def _scale(person: Keypoints, size: Size) -> Keypoints:
    return Keypoints(person.names, person.xy * size, person.confidence)


def read_labelled(path: str | Path) -> LabelledPeople:
    """Read people by what the file or folder calls their frames; InputError as of `read_keypoints`."""
    path = Path(path)
    if path.is_dir():
        return _read_folder(path)
    if path.suffix.lower() == ".txt":
        regression = StickRegression(DeformableStructures.load())
        return LabelledPeople(
            {number: [regression.to_keypoints(one) for one in people] for number, people in read_sticks(path).items()}
        )
    data = load_json(path)
    if isinstance(data, dict) and "joint_names" in data:
        return LabelledPeople(_read_own(data, path))
    into = DetectorFrames()
    # OpenPose names a frame's file after the image; any other file with one frame has that of index 0.
    label: Label = path.stem.removesuffix(FRAME_FILE_ENDING) if path.stem.endswith(FRAME_FILE_ENDING) else 0
    if not read_detector_json(data, label, str(path), into):
        raise InputError(f"{path} has none of the forms of keypoints that are read; expected is one of {FORMS}")
    return into.finish(str(path))


def load_json(path: Path) -> Any:
    """Return what is in a JSON file; InputError when it cannot be read or is none."""
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not a JSON file: {error}") from error


def _read_folder(folder: Path) -> LabelledPeople:
    """Read one file a frame; where some have OpenPose's ending, only those."""
    files = sorted(folder.glob("*.json"), key=natural_sort_key)
    files = [file for file in files if file.stem.endswith(FRAME_FILE_ENDING)] or files
    if not files:
        raise InputError(
            f"the folder {folder} has no JSON file; expected is one a frame as OpenPose writes them, "
            f"NAME_000000000012_keypoints.json with {FRAME_FORM}"
        )
    into = DetectorFrames()
    for file in files:
        if not read_detector_frame(load_json(file), file.stem.removesuffix(FRAME_FILE_ENDING), {}, str(file), into):
            raise InputError(f"{file} is no frame of keypoints; expected is {FRAME_FORM}")
    return into.finish(str(folder))


def _read_own(data: Mapping[str, Any], path: Path) -> dict[Label, list[Keypoints]]:
    """Read keypoints.json, tracks.json or poses.json."""
    frames = data.get("frames")
    if not isinstance(frames, dict | list):
        raise InputError(f'{path} needs "joint_names" and "frames": {{"0": [[[x, y, confidence], ...], ...]}}')
    names = data["joint_names"]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f'{path} needs "joint_names", a list of strings')
    if not any(normalise_name(name) for name in names):
        raise InputError(f"{path} has no known joint name, only {names[:3]} and the like")
    found: dict[Label, list[Keypoints]] = {}
    if isinstance(frames, list):
        for number, frame in enumerate(frames):
            label, people = _split_tracked(frame, f"{path}, frame {number}")
            found[label] = [_parse_person(tuple(names), rows, f"{path}, frame {number}") for rows in people]
        return found
    for key, people in frames.items():
        if not isinstance(people, list) or (key.isdecimal() and len(key) > MAX_INDEX_DIGITS):
            raise InputError(
                f"{path}: frame {key[:MAX_INDEX_DIGITS]!r} must be an index or an image's name, with a list of people"
            )
        found[int(key) if key.isdecimal() else key] = [
            _parse_person(tuple(names), rows, f"{path}, frame {key}") for rows in people
        ]
    return found


def _split_tracked(frame: Any, place: str) -> tuple[Label, list[Any]]:
    """Return the image, or else the index, of a frame of tracks.json and the joints of its puppets."""
    try:
        label = frame.get("path") or frame["index"]
        if not isinstance(label, int | str):
            raise TypeError(f"path or index is {label!r}")
        return label, [puppet["joints"] for puppet in frame["puppets"]]
    except (TypeError, KeyError, AttributeError) as error:
        raise InputError(f'{place} needs "index" and "puppets": [{{"joints": [[x, y, confidence], ...]}}]') from error


def _parse_person(names: tuple[str, ...], rows: Any, where: str) -> Keypoints:
    try:
        # null, the JSON for an unknown number, becomes NaN.
        values = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        values = np.empty(0)
    if values.shape != (len(names), 3):
        raise InputError(f"{where}: a person needs {len(names)} entries [x, y, confidence], one per joint name")
    return Keypoints(names, values[:, :2], np.nan_to_num(values[:, 2]))
