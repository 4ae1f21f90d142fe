# SPDX-License-Identifier: Apache-2.0
"""The position of the sensor in the header of a .pcd; Open3D reads the rest of the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

MAX_HEADER_BYTES = 4096


def read_viewpoint(path: Path) -> np.ndarray | None:
    """Return the translation (3,) in the line VIEWPOINT; None where it is missing, damaged, or the origin."""
    with path.open("rb") as file:
        header = file.read(MAX_HEADER_BYTES)
    for line in header.split(b"\n"):
        words = line.split()
        if words[:1] == [b"DATA"]:
            break
        if words[:1] == [b"VIEWPOINT"]:
            try:
                place = np.array([float(word) for word in words[1:4]])
            except ValueError:
                return None
            return place if len(place) == 3 and np.isfinite(place).all() and place.any() else None
    return None
