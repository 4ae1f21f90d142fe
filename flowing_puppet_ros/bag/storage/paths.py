# SPDX-License-Identifier: Apache-2.0
"""Recognise bags by their paths; imports nothing that takes time."""

import re
from pathlib import Path

SUFFIXES = (".mcap", ".db3", ".bag")
PACKED_SUFFIXES = (".zst", ".zstd", ".lz4", ".gz", ".bz2", ".xz")
"""Endings of compressed files, after that of the bag; what is in a file decides, not these."""
MAGICS = (b"\x89MCAP0\r\n", b"#ROSBAG V", b"SQLite format 3\0")
"""How bag files begin; a renamed one is known by that."""
_SPLIT = re.compile(r"(?P<series>.*?)(?:_\d{4}(?:-\d\d){5})?_(?P<number>\d+)")
"""Stem of a split file: rosbag2 counts from 0, `rosbag record --split` adds the time before the number."""


def bag_suffix(path: Path) -> str:
    """Return the ending of a bag file (.mcap, .db3, .bag), also under that of a compression; empty for other files.

    A ROS 1 recorder that was killed leaves `.bag.active`.
    """
    name = path.name.lower().removesuffix(".active")
    for packed in PACKED_SUFFIXES:
        name = name.removesuffix(packed)
    return next((suffix for suffix in SUFFIXES if name.endswith(suffix)), "")


def natural_order(path: Path) -> list[tuple[int, int, str]]:
    """Return the key that sorts the second file of a split bag before the tenth."""
    return [(0, int(word), "") if word.isdigit() else (1, 0, word) for word in re.split(r"(\d+)", path.name) if word]


def split_series(path: Path) -> str | None:
    """Return what the files of one split recording have in common: `drive` for drive_3.mcap; None for other names."""
    found = _SPLIT.fullmatch(_stem(path))
    return found and found["series"]


def is_bag(path: Path) -> bool:
    """Return whether a file or folder looks like one bag: by its suffix or content, its metadata, or the files in it.

    A recorder that was killed leaves no metadata, but its files are `<folder>_0`, `<folder>_1`, ... A renamed folder
    has files that still count from 0.
    """
    if not path.is_dir():
        return bool(bag_suffix(path)) or _begins_as_bag(path)
    files = [file for file in path.iterdir() if file.is_file() and bag_suffix(file)]
    if (path / "metadata.yaml").is_file() or len(files) == 1:
        return True
    series = {split_series(file) for file in files}
    if len(files) < 2 or len(series) > 1 or None in series:
        return False
    numbers = {int(found["number"]) for file in files if (found := _SPLIT.fullmatch(_stem(file)))}
    return series == {path.resolve().name} or numbers == set(range(len(files)))


def _begins_as_bag(path: Path) -> bool:
    try:
        with path.open("rb") as stream:
            return stream.read(16).startswith(MAGICS)
    except OSError:
        return False


def _stem(path: Path) -> str:
    suffix = bag_suffix(path)
    return path.name[: path.name.lower().rindex(suffix)] if suffix else path.stem
