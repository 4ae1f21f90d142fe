# SPDX-License-Identifier: Apache-2.0
"""The videos or image folders of several cameras in a folder, and the keypoint files that belong to them."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.frame_names import FrameNames
from flowing_puppet_ros.image.formats.keypoint_files import read_keypoints
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.video_reader import IMAGE_SUFFIXES, FrameSource, natural_sort_key, open_frames

VIDEO_SUFFIXES = frozenset({".mp4", ".avi", ".mov", ".mkv", ".m4v", ".mpg", ".mpeg", ".webm", ".wmv", ".mts"})
_INNER_FOLDERS = ("videos", "images", "recordings")
_KEYPOINT_FOLDERS = ("", "pose", "keypoints", "annots", "pose-associated")
_KEYPOINT_ENDINGS = ("", "_json", "_keypoints", "-keypoints", "_pose", "_alphapose", "_openpose")

type Warn = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class CameraSource:
    """The frames of one camera and the people that somebody found in them, by frame; None without keypoint files."""

    name: str
    frames: FrameSource
    people: Mapping[int, Sequence[Keypoints]] | None = None


def find_sources(folder: Path, warn: Warn, fps: float = 0.0) -> list[CameraSource]:
    """Return the cameras in a folder, or in its `videos` or `images`: a video or a folder of images each.

    `fps` replaces the rate of the files. InputError when there are fewer than two.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder: give the folder with one video or one folder of images per camera")
    for place in (folder, *(folder / inner for inner in _INNER_FOLDERS)):
        paths = _list_cameras(place) if place.is_dir() else []
        if len(paths) >= 2:
            sources = []
            for path in paths:
                frames = open_frames(path, warn)
                name = path.stem if path.is_file() else path.name
                sources.append(CameraSource(name, replace(frames, fps=fps) if fps else frames))
            return sources
    raise InputError(f"{folder} has no two videos and no two folders of images: one per camera is needed")


def _list_cameras(folder: Path) -> list[Path]:
    videos = [path for path in folder.iterdir() if path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES]
    if len(videos) >= 2:
        return sorted(videos, key=natural_sort_key)
    folders = [
        path
        for path in folder.iterdir()
        if path.is_dir()
        and path.name not in _INNER_FOLDERS
        and any(file.suffix.lower() in IMAGE_SUFFIXES for file in path.iterdir())
    ]
    return sorted(folders, key=natural_sort_key)


def match_names(videos: Sequence[str], cameras: Sequence[str], warn: Warn) -> dict[str, str]:
    """Return video -> camera of the calibration: of the same name, but for case, signs and leading zeros, or number.

    One that has no partner is warned of and left out. InputError when fewer than two have one.
    """
    for key in (str, _simplify, _last_number):
        keys = {key(name): name for name in cameras}
        found = {video: keys[key(video)] for video in videos if key(video) and key(video) in keys}
        if len(found) >= 2 and len(set(found.values())) == len(found) and len(keys) == len(cameras):
            break
    else:
        raise InputError(
            f"the videos {', '.join(videos)} and the calibrated cameras {', '.join(cameras)} have different names: "
            "give them the same"
        )
    for video in videos:
        if video not in found:
            warn(f"the calibration has no camera for {video}, which is left out; it has {', '.join(cameras)}")
    for camera in cameras:
        if camera not in found.values():
            warn(f"there is no video of {camera}, which is calibrated: it is left out")
    return found


def _simplify(name: str) -> str:
    words = re.sub("[^a-z0-9]", "", name.lower())
    return re.sub(r"\d+", lambda digits: digits[0].lstrip("0") or "0", words)


def _last_number(name: str) -> str:
    digits = re.findall(r"\d+", name)
    return digits[-1].lstrip("0") or "0" if digits else ""


def add_keypoints(source: CameraSource, folder: Path) -> CameraSource:
    """Return a camera with the keypoint file or folder beside its video, or in `pose` or `keypoints`; or as it is.

    It is called as the camera, or with _json, _keypoints or the like behind it.
    """
    for place in dict.fromkeys((folder, source.frames.path.parent, source.frames.path.parent.parent)):
        for inner in _KEYPOINT_FOLDERS:
            for ending in _KEYPOINT_ENDINGS:
                base = place / inner / f"{source.name}{ending}"
                for path in (base.with_name(base.name + ".json"), base):
                    if path.is_file() or (path.is_dir() and any(path.glob("*.json"))):
                        return replace(source, people=read_keypoints(path, FrameNames.of(source.frames)))
    return source
