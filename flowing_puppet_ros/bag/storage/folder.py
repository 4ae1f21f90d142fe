# SPDX-License-Identifier: Apache-2.0
"""Which files of a folder are one recording, by what is there and by its metadata.yaml, which may be wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from flowing_puppet_ros.bag.storage.paths import bag_suffix, natural_order, split_series
from flowing_puppet_ros.bag.storage.stored_file import StoredTopic, parse_qos
from flowing_puppet_ros.errors import InputError

METADATA = "metadata.yaml"


@dataclass(slots=True)
class RecordingFiles:
    """The files of a recording in their order, what its metadata says of topics, and notes on what does not fit."""

    files: list[Path]
    listed_topics: list[StoredTopic] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def find_recording(folder: Path) -> RecordingFiles:
    """Return the files of the recording in a folder; InputError if there are none.

    Read are the files that metadata.yaml lists and those that stand beside them as further splits of them, even if it
    does not list them. Without a readable metadata.yaml, or if none of its files is there, all bag files are read, of
    one kind if there are several.
    """
    there = sorted((path for path in folder.iterdir() if path.is_file() and bag_suffix(path)), key=natural_order)
    information, problem = _read_metadata(folder / METADATA)
    if information is None:
        if not there:
            found = f"its {METADATA} {problem}" if problem else f"it has no {METADATA}"
            raise InputError(f"the folder {folder} is not a bag: {found} and 0 bag files")
        recording = RecordingFiles(_choose_kind(there))
        recording.notes += [f"{folder / METADATA} {problem}: all files beside it are read"] if problem else []
    else:
        recording = _follow_metadata(folder, information, there)
    unread = [path.name for path in there if path not in recording.files]
    if unread:
        recording.notes.append(
            f"{folder}: {', '.join(unread)} {'is' if len(unread) == 1 else 'are'} not part of the recording and not "
            "read; what is wanted of it can be given by its path"
        )
    recording.notes += [f"{path} is empty" for path in recording.files if not path.stat().st_size]
    recording.files = [path for path in recording.files if path.stat().st_size] or recording.files
    return recording


def _read_metadata(path: Path) -> tuple[Mapping[str, Any] | None, str]:
    """Return what rosbag2 says about a recording, or None and what is wrong with it; "" if there is no such file."""
    if not path.is_file():
        return None, ""
    try:
        content = YAML(typ="safe").load(path.read_text("utf8"))
    except (OSError, UnicodeDecodeError, YAMLError, ValueError):
        return None, "cannot be read as YAML"
    if content is None:
        return None, "is empty"
    information = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    if not isinstance(information, dict) or not isinstance(information.get("relative_file_paths"), list):
        return None, "is not that of a rosbag2 bag"
    return information, ""


def _follow_metadata(folder: Path, information: Mapping[str, Any], there: list[Path]) -> RecordingFiles:
    # Older versions list paths with the folder's name, which may have been another.
    listed = [folder / PurePosixPath(str(name)).name for name in information["relative_file_paths"]]
    known = [path for path in dict.fromkeys(listed) if path.is_file()]
    gone = [path for path in dict.fromkeys(listed) if not path.is_file()]
    recording = RecordingFiles([*known], _list_topics(information))
    if not known and not there:
        raise InputError(f"the folder {folder} is not a bag: {', '.join(path.name for path in gone)} is not in it")
    others = [path for path in there if path not in known]
    series = {split_series(path) for path in listed}
    splits = [path for path in others if split_series(path) in series]
    # A file in the place of one that is gone was renamed.
    added = splits if known and len(others) - len(splits) != len(gone) else others if gone else splits
    if not known:
        added = _choose_kind(others)
    recording.files = sorted([*known, *added], key=natural_order) if added else known
    if gone:
        instead = (
            f"; instead {', '.join(path.name for path in added)} is read" if added else ", its messages are missing"
        )
        recording.notes.append(f"{folder / METADATA} lists {', '.join(p.name for p in gone)}, which is gone{instead}")
    elif added:
        names = ", ".join(path.name for path in added)
        recording.notes.append(f"{folder / METADATA} does not list {names}, which is read too")
    return recording


def _choose_kind(files: list[Path]) -> list[Path]:
    """Return the files of the kind that is preferred when a recording is there as several."""
    kinds = [bag_suffix(path) for path in files]
    chosen = next((kind for kind in (".mcap", ".db3", ".bag") if kind in kinds), "")
    return [path for path, kind in zip(files, kinds, strict=True) if kind == chosen]


def _list_topics(information: Mapping[str, Any]) -> list[StoredTopic]:
    """Return the topics that the metadata lists, as far as they are readable; their counts may be wrong and are 0."""
    found = []
    entries = information.get("topics_with_message_count")
    for entry in entries if isinstance(entries, list) else []:
        about = entry.get("topic_metadata") if isinstance(entry, dict) else None
        if isinstance(about, dict) and isinstance(about.get("name"), str) and isinstance(about.get("type"), str):
            profiles = about.get("offered_qos_profiles")
            qos = parse_qos(profiles) if isinstance(profiles, str) else ()
            encoding = str(about.get("serialization_format", "cdr"))
            found.append(StoredTopic(about["name"], about["type"], encoding, "", b"", 0, qos))
    return found
