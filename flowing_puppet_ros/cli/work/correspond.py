# SPDX-License-Identifier: Apache-2.0
"""What the verb `correspond` does."""

from __future__ import annotations

import argparse
import json
import zipfile
from pathlib import Path

import numpy as np

from flowing_puppet_ros.body.scans.scan import read_scan, to_smallest_float
from flowing_puppet_ros.body.scans.scan_correspondence import correspond
from flowing_puppet_ros.errors import InputError


def run(arguments: argparse.Namespace) -> int:
    """Write each scan A vertex's point on scan B, in scan B's frame and unit."""
    vertices_a, faces_a = _read_fit(arguments.fit_a)
    vertices_b, faces_b = _read_fit(arguments.fit_b)
    if not np.array_equal(faces_a, faces_b):
        raise InputError(f"{arguments.fit_a} and {arguments.fit_b} are fits of different models; fit both with one")
    scan_a, scan_b = read_scan(arguments.scan_a), read_scan(arguments.scan_b)
    points, distance = correspond(vertices_a, vertices_b, faces_a, scan_a, scan_b)
    try:
        with arguments.out.open("wb") as file:
            np.savez_compressed(file, points=to_smallest_float(points), distance=distance.astype(np.float32))
    except OSError as error:
        raise InputError(f"--out {arguments.out} cannot be written: {error.strerror}") from error
    if arguments.json:
        summary = {"output": str(arguments.out), "pairs": len(points), "mean_distance": float(distance.mean())}
        print(json.dumps(summary))
    return 0


def _read_fit(path: Path) -> tuple[np.ndarray, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            vertices, faces = arrays["vertices"].astype(np.float64), arrays["faces"].astype(np.int64)
        if not (vertices.shape[1:] == faces.shape[1:] == (3,) and faces.min() >= 0 and faces.max() < len(vertices)):
            raise ValueError("vertices and faces do not make a mesh")
        return vertices, faces
    except (OSError, ValueError, KeyError, TypeError, AttributeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} is not a fit; make one with `flowing-puppet fit`") from error
