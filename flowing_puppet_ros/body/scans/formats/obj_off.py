# SPDX-License-Identifier: Apache-2.0
"""Readers of the two plain-text mesh formats, .obj and .off; both keep the file's order of vertices.

They are our own because damaged and hostile (fuzzed) files must end in an `InputError`, never in a crash.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from flowing_puppet_ros.body.cloud.mesh_geometry import triangulate_fans
from flowing_puppet_ros.body.scans.formats.tables import read_text_file
from flowing_puppet_ros.errors import InputError


def read_obj(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read vertices (N, 3) and triangles (F, 3) of a Wavefront file; polygons become fans, everything else is skipped.

    Raises:
        InputError: when a line of a vertex or a face cannot be read.
    """
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    for number, line in enumerate(_read_lines(path), start=1):
        words = line.split("#")[0].split()
        try:
            if words[:1] == ["v"]:
                vertices.append([float(word) for word in words[1:4]])
                if len(vertices[-1]) < 3:
                    raise ValueError
            elif words[:1] == ["f"]:
                corners = [int(word.split("/")[0]) for word in words[1:]]
                # Negative numbers count back from the last vertex so far.
                polygons.append([corner - 1 if corner > 0 else len(vertices) + corner for corner in corners])
        except ValueError:
            raise InputError(
                f"{path} cannot be read at line {number}, {line.strip()[:40]!r}; export it again"
            ) from None
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), triangulate_fans(polygons)


def read_off(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read vertices (N, 3) and triangles (F, 3) of an Object File Format file; polygons become fans.

    Raises:
        InputError: when it is not an .off file or ends before its last face.
    """
    lines = [words for line in _read_lines(path) if (words := line.split("#")[0].split())]
    start = re.fullmatch(r"[A-Z4]*OFF(\d*)", lines[0][0]) if lines else None
    if start is None:
        raise InputError(f"{path} does not begin with OFF; export it again")
    counts = [start[1]] * bool(start[1]) + lines[0][1:]
    if counts:  # on the first line, even without a space before them
        lines.insert(1, counts)
    try:
        count, faces = int(lines[1][0]), int(lines[1][1])
        body = lines[2 : 2 + count + faces]
        vertices = np.array([[float(word) for word in words[:3]] for words in body[:count]], dtype=np.float64)
        polygons = [[int(word) for word in words[1 : 1 + int(words[0])]] for words in body[count:]]
        complete = len(body) == count + faces and all(
            len(polygon) == int(words[0]) for polygon, words in zip(polygons, body[count:], strict=True)
        )
    except (ValueError, IndexError):
        complete = False
    if not complete:
        raise InputError(f"{path} ends early or is damaged; export it again and check that it is complete")
    return vertices.reshape(-1, 3), triangulate_fans(polygons)


def _read_lines(path: Path) -> list[str]:
    """Return the lines of a text; one that ends in a backslash goes on in the next."""
    return re.sub(r"\\[ \t]*\r?\n", " ", read_text_file(path)).splitlines()
