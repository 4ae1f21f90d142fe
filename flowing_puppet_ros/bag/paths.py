# SPDX-License-Identifier: Apache-2.0
"""Recognise bags by their paths; imports nothing that takes time."""

import re
from pathlib import Path

SUFFIXES = (".mcap", ".db3")


def is_bag(path: Path) -> bool:
    """Return whether a file or folder looks like one bag: by its suffix, its metadata, or the bag files in it.

    A recorder that was killed leaves no metadata, but its files are `<folder>_0`, `<folder>_1`, ...
    """
    if not path.is_dir():
        return path.suffix.lower() in SUFFIXES
    files = [file for suffix in SUFFIXES for file in path.glob(f"*{suffix}")]
    split = all(re.fullmatch(re.escape(path.resolve().name) + r"_\d+", file.stem) for file in files)
    return (path / "metadata.yaml").is_file() or len(files) == 1 or (len(files) > 1 and split)
