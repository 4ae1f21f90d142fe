# SPDX-License-Identifier: Apache-2.0
"""Print what the package's requirements take on the disk, by distribution: `make install-size`.

Sizes are those of the files that the installed distributions list, without bytecode, which Python writes as it runs.
Each environment's Python measures its own; that of `.venv-noble` has the versions of Ubuntu 24.04.
"""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from importlib.metadata import distribution
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RECORDINGS = frozenset({"lz4", "mcap", "protobuf", "rosbags", "zstandard"})
"""Requirements that only recordings need: nodes import none of them, as test/cli/test_extras.py holds."""
MEGABYTE = 1e6


@dataclass(frozen=True)
class Size:
    """The bytes of a distribution's files."""

    name: str
    version: str
    bytes: int


def normalise(name: str) -> str:
    """Return a distribution's name as the package index compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def read_requirements(name: str) -> set[str]:
    """Return the distributions that requirements/`name`.txt names."""
    lines = (ROOT / "requirements" / f"{name}.txt").read_text().splitlines()
    found = (re.match(r"[A-Za-z0-9._-]+", line) for line in lines)
    return {normalise(match.group()) for match in found if match}


def find_closure(names: set[str]) -> set[str]:
    """Return the distributions with everything that they require here, without extras."""
    closure: set[str] = set()
    open_names = set(names)
    while open_names:
        name = open_names.pop()
        closure.add(name)
        for line in distribution(name).requires or []:
            requirement, _, marker = line.partition(";")
            match = re.match(r"[A-Za-z0-9._-]+", requirement)
            if match and "extra ==" not in marker and applies(marker):
                open_names |= {normalise(match.group())} - closure
    return closure


def applies(marker: str) -> bool:
    """Return whether a requirement with this marker is one on this machine."""
    from packaging.markers import Marker

    return not marker.strip() or Marker(marker.strip()).evaluate()


def measure(name: str) -> Size:
    """Return the size of an installed distribution; links and bytecode count nothing."""
    found = distribution(name)
    paths = [Path(str(found.locate_file(file))) for file in found.files or []]
    kept = [path for path in paths if path.suffix != ".pyc" and path.is_file() and not path.is_symlink()]
    return Size(name, found.version, sum(path.stat().st_size for path in kept))


def print_sizes(title: str, names: set[str]) -> None:
    """Print a table of the closure of `names`, largest first, and its sum."""
    sizes = sorted(map(measure, find_closure(names)), key=lambda size: -size.bytes)
    print(f"{title}: {sum(size.bytes for size in sizes) / MEGABYTE:.0f} MB")
    for size in sizes:
        print(f"  {size.bytes / MEGABYTE:6.1f} MB  {size.name} {size.version}")


if __name__ == "__main__":
    runtime = read_requirements("runtime")
    print_sizes("nodes", runtime - RECORDINGS)
    print_sizes("nodes, replay and command line", runtime)
    print(f"of {sys.prefix}", file=sys.stderr)
