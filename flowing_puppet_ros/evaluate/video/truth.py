# SPDX-License-Identifier: Apache-2.0
"""A folder of clips, and the people in their frames: the ground truth, or the tracker's initial detections.

A clip is a video file or a sub-folder of images. People are read from one JSON of all clips, whose images or frames are
named after their clip, from any file of keypoints if there is one clip, or from a folder with a file or sub-folder of
keypoints named after each clip. See `image.formats.annotations` and `image.formats.keypoint_files`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.annotations import Annotations
from flowing_puppet_ros.image.formats.frame_names import FrameNames
from flowing_puppet_ros.image.formats.keypoint_files import load_json, place_people, read_keypoints, read_labelled
from flowing_puppet_ros.image.formats.keypoints import Keypoints
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
        places = {name: _find_keypoints(path, clip.stem) for name, clip in clips.items()}
        found: dict[str, PeopleByFrame] = {
            name: read_keypoints(place, FrameNames.of(open_frames(clips[name])))
            for name, place in places.items()
            if place
        }
        found = found or _select_named(path, clips)
    elif _is_annotated(load_json(path)):
        found = _select_annotated(Annotations.load(path), clips)
    else:
        found = _select_named(path, clips)
    found = {name: people for name, people in found.items() if any(people.values())}
    if not found:
        raise InputError(f"{path} has no person in any of the clips {', '.join(list(clips)[:3])} ...")
    return found


def _find_keypoints(folder: Path, stem: str) -> Path | None:
    """Return a clip's file of keypoints in the folder, or its sub-folder with one a frame."""
    file = folder / f"{stem}.json"
    if file.is_file():
        return file
    return folder / stem if any((folder / stem).glob("*.json")) else None


def _is_annotated(data: object) -> bool:
    """Return whether JSON has one of the layouts of `Annotations`."""
    return isinstance(data, dict) and "joint_names" in data and ("images" in data or "clips" in data)


def _select_named(path: Path, clips: Clips) -> dict[str, PeopleByFrame]:
    """Select the people of the clips from keypoints; with several clips, their frames are named after them."""
    labelled = read_labelled(path)
    frames = {name: FrameNames.of(open_frames(clip)) for name, clip in clips.items()}
    if len(clips) == 1:
        return {name: place_people(labelled, names, path) for name, names in frames.items()}
    if any(isinstance(label, int) for label in labelled.people):
        raise InputError(f"{path} has the frames of one clip, but there are {len(clips)}; choose one with --clips")
    found: dict[str, PeopleByFrame] = {}
    for name, names in frames.items():
        own = {label: people for label, people in labelled.people.items() if names.includes(label)}
        if any(own.values()):
            found[name] = place_people(replace(labelled, people=own), names, path)
    return found


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
