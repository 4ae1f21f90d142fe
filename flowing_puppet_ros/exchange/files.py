# SPDX-License-Identifier: Apache-2.0
"""Write people into the files of one format."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flowing_puppet_ros.exchange.body_json import write_json
from flowing_puppet_ros.exchange.bvh import write_bvh
from flowing_puppet_ros.exchange.glb import write_glb
from flowing_puppet_ros.exchange.motion import BodyMotion
from flowing_puppet_ros.exchange.trc import write_trc

_WRITERS = {"glb": write_glb, "bvh": write_bvh, "trc": write_trc}


def write_people(people: Sequence[BodyMotion], form: str, folder: Path) -> list[Path]:
    """Write people into a folder and return the files: one a person, of obj one a frame, of json one for all.

    Raises:
        OSError: when a file cannot be written.
    """
    names = [re.sub(r"[^\w.-]", "_", person.name) for person in people]
    if form == "json":
        stem = names[0] if len(people) == 1 else names[0].removesuffix(f"-{people[0].identity}")
        write_json(folder / f"{stem}.json", people)
        return [folder / f"{stem}.json"]
    files = []
    for name, person in zip(names, people, strict=True):
        if form == "obj":
            files += _write_meshes(folder, name, person)
        else:
            files.append(folder / f"{name}.{form}")
            _WRITERS[form](files[-1], person)
    return files


def _write_meshes(folder: Path, name: str, person: BodyMotion) -> list[Path]:
    count = len(person.stamps_ns)
    stems = [name] if count == 1 else [f"{name}-{frame:06d}" for frame in range(count)]
    for frame, stem in enumerate(stems):
        write_obj(folder / f"{stem}.obj", person, frame)
    return [folder / f"{stem}.obj" for stem in stems]


def write_obj(path: Path, motion: BodyMotion, frame: int) -> None:
    """Write the mesh of one frame, metres, y up, with a group for each part."""
    model = motion.model
    lines = [f"# {motion.name}: metres, y up", *(f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in motion.vertices[frame])]
    part_of_face = np.sort(model.part_of_vertex[model.faces], axis=1)[:, 1]  # of two corners at least
    for part, name in enumerate(model.tree.names):
        lines.append(f"g {name}")
        lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in model.faces[part_of_face == part]]
    path.write_text("\n".join(lines) + "\n", "utf8")
