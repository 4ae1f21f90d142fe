# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet sample sp`: random 3D puppets as .ply meshes, and a contact sheet of them."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from flowing_puppet_ros.body.scans.scan import write_ply
from flowing_puppet_ros.cli.sample.samples import add_common_arguments, draw_samples
from flowing_puppet_ros.draw.mesh_render import fit_orthographic_camera, render
from flowing_puppet_ros.draw.palette import part_colours
from flowing_puppet_ros.draw.pictures import make_contact_sheet, save
from flowing_puppet_ros.model.sp import StitchedPuppet

SIZE_PX = (300, 440)
PIXELS_PER_METRE = 200.0  # the same for all bodies
VIEWS = ((-1.0, -0.4, -0.15), (0.4, -1.0, -0.15))  # viewing directions: from the front and from behind on the left
COLUMNS = 8  # of the contact sheet
FILES = "sp_GENDER_000.ply ... and sp_GENDER.png"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `sample sp`."""
    add_common_arguments(parser, FILES)


def run(arguments: argparse.Namespace) -> int:
    """Draw the samples, print the paths of the files and return the exit status."""
    return draw_samples(arguments, draw)


def draw(arguments: argparse.Namespace, rng: np.random.Generator) -> Iterator[Path]:
    """Write the bodies as meshes and on one sheet, and yield their paths."""
    model = StitchedPuppet.load(arguments.gender)
    colours = part_colours(model.tree.names)[model.part_of_vertex]
    pictures = []
    for index in range(arguments.count):
        vertices = model.vertices(model.sample(rng))
        path = arguments.out / f"sp_{model.name}_{index:03d}.ply"
        write_ply(path, vertices, model.faces, colours)
        yield path
        for looking in VIEWS:
            camera = fit_orthographic_camera(vertices, looking, SIZE_PX, scale=PIXELS_PER_METRE)
            pictures.append(render(vertices, model.faces, camera, SIZE_PX, colours.astype(np.float64)).rgb)
    sheet = arguments.out / f"sp_{model.name}.png"
    save(make_contact_sheet(pictures, COLUMNS), sheet)
    yield sheet
