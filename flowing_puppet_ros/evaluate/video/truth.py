# SPDX-License-Identifier: Apache-2.0
"""A folder of clips, and the people in their frames: the ground truth, or the tracker's initial detections.

A clip is a video file or a sub-folder of images. People are read from one JSON of all clips, from one keypoints.json if
there is one clip, or from a folder with a keypoints file named after each clip. See `image.formats.annotations`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.annotations import Annotations
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.tracks_json import read_keypoints
from flowing_puppet_ros.image.formats.video_reader import IMAGE_SUFFIXES, open_frames

VIDEO_SUFFIXES = frozenset({".avi", ".mp4", ".m4v", ".mkv", ".mov", ".mpg", ".mpeg", ".webm"})

type Clips = Mapping[str, Path]
"""Video files and folders of images by clip name."""

type PeopleByFrame = Mapping[int, Sequence[Keypoints]]
"""People of a clip by frame; frames that were not annotated are absent."""


def find_clips(folder: Path, wanted: Sequence[str] = ()) -> dict[str, Path]:
    """Find the clips of a folder, or only those that are `wanted`; InputError if there is none or one is missing.

    A video file, or a folder that holds images itself, is one clip.
    """
    if not folder.exists():
        raise InputError(f"{folder} does not exist; name a folder of videos, or of sub-folders of images")
    if folder.is_file() or _has_images(folder):
        clips = {folder.name: folder}
    else:
        places = sorted(folder.iterdir())
        clips = {place.name: place for place in places if place.suffix.lower() in VIDEO_SUFFIXES or _has_images(place)}
    if not clips:
        raise InputError(f"{folder} has no clip: no video ({' '.join(sorted(VIDEO_SUFFIXES))}) and no folder of images")
    if not wanted:
        return clips
    chosen = {name: path for name, path in clips.items() if name in wanted or path.stem in wanted}
    missing = [name for name in wanted if name not in chosen and name not in {path.stem for path in chosen.values()}]
    if missing:
        raise InputError(f"{folder} has no clip {missing[0]!r}; it has {', '.join(list(clips)[:3])} ...")
    return chosen


def _has_images(place: Path) -> bool:
    return place.is_dir() and any(file.suffix.lower() in IMAGE_SUFFIXES for file in place.iterdir())


def read_people(path: Path, clips: Clips) -> dict[str, PeopleByFrame]:
    """Read people by clip from the file or folder `path`; InputError if it covers none of the clips."""
    if path.is_dir():
        files = {name: path / f"{clip.stem}.json" for name, clip in clips.items()}
        found: dict[str, PeopleByFrame] = {name: read_keypoints(file) for name, file in files.items() if file.is_file()}
    elif "frames" in _read_object(path):
        if len(clips) != 1:
            raise InputError(f"{path} has the frames of one clip, but there are {len(clips)}; choose one with --clips")
        found = {name: read_keypoints(path) for name in clips}
    else:
        found = _select_annotated(Annotations.load(path), clips)
    found = {name: people for name, people in found.items() if any(people.values())}
    if not found:
        raise InputError(f"{path} has no person in any of the clips {', '.join(list(clips)[:3])} ...")
    return found


def read_named_people(path: Path) -> dict[int | str, list[Keypoints]]:
    """Read a keypoints.json whose frames are indices or names of images; InputError for any other file."""
    data = _read_object(path)
    names, frames = data.get("joint_names"), data.get("frames")
    if not isinstance(names, list) or not isinstance(frames, dict) or all(key.isdecimal() for key in frames):
        return dict(read_keypoints(path).items())
    try:
        # null, the JSON for an unknown number, becomes NaN.
        rows = {file: [np.array(person, np.float64) for person in people] for file, people in frames.items()}
        return {
            file: [Keypoints(tuple(names), person[:, :2], np.nan_to_num(person[:, 2])) for person in people]
            for file, people in rows.items()
        }
    except (TypeError, ValueError, IndexError) as error:
        raise InputError(
            f"{path}: a person needs {len(names)} entries [x, y, confidence], one per joint name"
        ) from error


def _read_object(path: Path) -> Mapping[str, object]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not a JSON file: {error}") from error
    return data if isinstance(data, dict) else {}


def _select_annotated(annotations: Annotations, clips: Clips) -> dict[str, PeopleByFrame]:
    """Select the annotated people of the clips; images in a clip's folder are its frames in natural order."""
    names = {known: name for name, clip in clips.items() for known in (name, clip.stem)}
    found: dict[str, dict[int, Sequence[Keypoints]]] = {}
    for file, frames in annotations.people.items():
        place = Path(file)
        people = {index: [person.keypoints for person in persons] for index, persons in frames.items()}
        if file in names or place.stem in names:
            found.setdefault(names.get(file) or names[place.stem], {}).update(people)
        elif place.parent.name in names:
            clip = clips[names[place.parent.name]]
            order = [image.name for image in open_frames(clip).files]
            if place.name in order:
                found.setdefault(names[place.parent.name], {})[order.index(place.name)] = people[0]
    return {name: dict(people) for name, people in found.items()}
