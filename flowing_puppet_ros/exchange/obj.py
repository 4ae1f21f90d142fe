# SPDX-License-Identifier: Apache-2.0
"""Write the mesh of one frame of a person as OBJ (Wavefront)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flowing_puppet_ros.exchange.motion import BodyMotion


def write_obj(path: Path, motion: BodyMotion, frame: int) -> None:
    """Write the mesh of one frame, metres, y up, with a group for each part."""
    model = motion.model
    lines = [f"# {motion.name}: metres, y up", *(f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in motion.vertices[frame])]
    part_of_face = np.sort(model.part_of_vertex[model.faces], axis=1)[:, 1]  # of two corners at least
    for part, name in enumerate(model.tree.names):
        lines.append(f"g {name}")
        lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in model.faces[part_of_face == part]]
    path.write_text("\n".join(lines) + "\n", "utf8")
