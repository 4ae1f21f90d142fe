# SPDX-License-Identifier: Apache-2.0
"""People annotated on images: folders of the annotation tool, and lists of joints per video clip.

Two JSON layouts are read. The annotation tool's has one entry per image or video frame,
`{"joint_names": [...], "images": {"street.png": [PERSON, ...], "walk.avi#12": [PERSON, ...]}}` with PERSON
`{"joints": [[x, y, visible], ...], "gender": "female", "view": "front"}`, paths relative to the JSON. The other has one
person per video, `{"joint_names": [...], "clips": {"walk.avi": [[[x, y, visibility], ...] or null, ...]}}` (or
`{"joints": that list}` in place of the list), with the videos in a folder of their own. Pixels; left is the person's.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from flowing_puppet_ros.arrays import U8
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.video_reader import open_frames
from flowing_puppet_ros.model.ds.shape import View

HIDDEN_CONFIDENCE = 0.2
"""Confidence of a joint annotated as hidden: its position is a guess, yet a good one."""

VIEWS: Mapping[str, View] = {"front": "front", "back": "back"}
CLIPS_FOLDER = "clips"
_ACTIONS = (
    "brush_hair|catch|clap|climb_stairs|golf|jump|kick_ball|pick|pour|pullup|push|run|shoot_ball|shoot_bow|shoot_gun"
    "|sit|stand|swing_baseball|throw|walk|wave"
)
_CLIP_NAME = re.compile(rf"(.+?)_({_ACTIONS})_[a-z]_(?:cm|nm)_np\d_[a-z]{{2}}_[a-z]{{3}}_\d+")


@dataclass(frozen=True, slots=True, eq=False)
class AnnotatedPerson:
    """Joints of one person in px (hidden ones have at most HIDDEN_CONFIDENCE), gender, and the side seen if known."""

    keypoints: Keypoints
    gender: str
    view: View | None


@dataclass(frozen=True, slots=True, eq=False)
class AnnotatedFrame:
    """An image (H, W, 3) RGB uint8 and its people. `file` is relative to the folder, `index` the frame of a video.

    `previous` is the image before it in the video, None for the first and for still images.
    """

    file: str
    index: int
    image: U8
    people: tuple[AnnotatedPerson, ...]
    previous: U8 | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Annotations:
    """The people of every annotated file: `people[file][frame]`; still images have frame 0 alone."""

    folder: Path
    people: Mapping[str, Mapping[int, tuple[AnnotatedPerson, ...]]]

    @classmethod
    def load(cls, path: Path, folder: Path | None = None) -> Self:
        """Read a JSON file of either layout; InputError, naming the entry, when it is not one.

        `folder` holds the images or videos; without it they are beside the JSON (videos in `clips` beside it).
        """
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise InputError(f"the annotations {path} cannot be read: {error.strerror}") from error
        except ValueError as error:
            raise InputError(f"the annotations {path} are not JSON: {error}") from error
        try:
            names = tuple(str(name) for name in data["joint_names"])
            if "images" in data:
                return cls(folder or path.parent, _parse_images(data["images"], names))
            return cls(folder or path.parent / CLIPS_FOLDER, _parse_clips(data["clips"], names))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(
                f"the annotations {path} have neither layout that is read (joint_names with images, or with clips): "
                f"{type(error).__name__} {error}"
            ) from error

    def __len__(self) -> int:
        """Return the number of annotated frames."""
        return sum(len(frames) for frames in self.people.values())

    def exclude_sources_of(self, other: Annotations) -> Annotations:
        """Return the annotations without the files in `other` and without clips cut from the same videos."""
        known = {source_video(file) for file in other.people}
        kept = {file: frames for file, frames in self.people.items() if source_video(file) not in known}
        return Annotations(self.folder, kept)

    def read_frames(self, every: int = 1) -> Iterator[AnnotatedFrame]:
        """Yield the frames in order of file and index: the first of each file and every `every`-th after it.

        InputError when a file is missing, cannot be decoded or is shorter than its annotation.
        """
        for file in sorted(self.people):
            wanted = sorted(self.people[file])[::every]
            if not wanted:
                continue
            before = None
            for frame in open_frames(self.folder / file):
                if frame.index in wanted:
                    yield AnnotatedFrame(file, frame.index, frame.image, self.people[file][frame.index], before)
                before = frame.image
                if frame.index >= wanted[-1]:
                    break
            else:
                raise InputError(f"{self.folder / file} has no frame {wanted[-1]}, which is annotated")


def source_video(file: str) -> str:
    """Return the name of the video that an HMDB or JHMDB clip was cut from; for other names the name without suffix.

    "Flaming_B52_Shot_Drink_pour_u_nm_np1_fr_med_0.avi" gives "Flaming_B52_Shot_Drink".
    """
    stem = str(Path(file).with_suffix(""))
    match = _CLIP_NAME.fullmatch(stem)
    return match[1] if match else stem


def _parse_images(
    images: Mapping[str, Any], names: tuple[str, ...]
) -> dict[str, dict[int, tuple[AnnotatedPerson, ...]]]:
    people: dict[str, dict[int, tuple[AnnotatedPerson, ...]]] = {}
    for key, entries in images.items():
        file, mark, index = key.rpartition("#")
        if not (mark and index.isdigit()):
            file, index = key, "0"
        persons = (
            AnnotatedPerson(
                _parse_keypoints(entry["joints"], names, HIDDEN_CONFIDENCE),
                entry.get("gender", "neutral"),
                VIEWS.get(entry.get("view")),
            )
            for entry in entries
        )
        people.setdefault(file, {})[int(index)] = tuple(persons)
    return people


def _parse_clips(clips: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, dict[int, tuple[AnnotatedPerson, ...]]]:
    people: dict[str, dict[int, tuple[AnnotatedPerson, ...]]] = {}
    for file, clip in clips.items():
        rows = clip["joints"] if isinstance(clip, dict) else clip
        people[file] = {
            index: (AnnotatedPerson(_parse_keypoints(row, names, 0.0), "neutral", None),)
            for index, row in enumerate(rows)
            if row is not None
        }
    return people


def _parse_keypoints(
    joints: Sequence[Sequence[float | None]], names: tuple[str, ...], hidden_confidence: float
) -> Keypoints:
    rows = np.array([[*joint, 1.0][:3] for joint in joints], np.float64).reshape(-1, 3)
    known = np.isfinite(rows).all(axis=1)
    return Keypoints(names, rows[:, :2], np.where(known, np.maximum(rows[:, 2], hidden_confidence), 0.0))
