# SPDX-License-Identifier: Apache-2.0
"""Readers of the two mesh formats that are plain text, .obj and .off; both keep the file's order of vertices."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flowing_puppet_ros.errors import InputError


def read_obj(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read vertices (N, 3) and triangles (F, 3) of a Wavefront file; polygons become fans, all else is skipped.

    Raises:
        InputError: when a vertex or face line cannot be read.
    """
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    for number, line in enumerate(_lines(path), start=1):
        words = line.split()
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
            raise InputError(f"{path} cannot be read at line {number}, {line.strip()[:40]!r}; write it again") from None
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), _fans(polygons)


def read_off(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read vertices (N, 3) and triangles (F, 3) of an Object File Format file; polygons become fans.

    Raises:
        InputError: when it is not an OFF file or ends before its last face.
    """
    lines = [words for line in _lines(path) if (words := line.split("#")[0].split())]
    if not lines or not lines[0][0].endswith("OFF"):
        raise InputError(f"{path} does not begin with OFF; write it again")
    if lines[0] != ["OFF"] and len(lines[0]) > 1:
        lines.insert(1, lines[0][1:])
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
        raise InputError(f"{path} ends early or is damaged; write it again and check that it is complete")
    return vertices.reshape(-1, 3), _fans(polygons)


def _lines(path: Path) -> list[str]:
    return path.read_text(encoding="utf-8", errors="replace").splitlines()


def _fans(polygons: list[list[int]]) -> np.ndarray:
    triangles = [[face[0], face[k], face[k + 1]] for face in polygons for k in range(1, len(face) - 1)]
    return np.array(triangles, dtype=np.int64).reshape(-1, 3)
