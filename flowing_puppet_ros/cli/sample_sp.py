# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet sample sp`: random 3D puppets as .ply meshes, and a contact sheet of them."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from flowing_puppet_ros.body.io import write_ply
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.view.mesh_render import orthographic, render
from flowing_puppet_ros.view.palette import part_colours
from flowing_puppet_ros.view.pictures import contact_sheet, save

SIZE = (300, 440)  # pixels
SCALE = 200.0  # pixels per metre, the same for all bodies
VIEWS = ((-1.0, -0.4, -0.15), (0.4, -1.0, -0.15))  # looking directions: from the front and from behind at the left
COLUMNS = 8


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of `sample sp`."""
    parser.add_argument("--gender", default="neutral", help="neutral, female or male [%(default)s]")
    parser.add_argument("--count", type=int, default=8, help="bodies [%(default)s]")
    parser.add_argument("--seed", type=int, default=0, help="seed of the samples [%(default)s]")
    parser.add_argument("--out", type=Path, required=True, help="folder for sp_GENDER_000.ply ... and sp_GENDER.png")


def run(arguments: argparse.Namespace) -> int:
    """Draw the bodies, write meshes and contact sheet, and print their paths."""
    if arguments.count < 1:
        raise InputError(f"--count is {arguments.count}; draw at least 1")
    if arguments.seed < 0:
        raise InputError(f"--seed is {arguments.seed}; it must be 0 or more")
    model = StitchedPuppet.load(arguments.gender)
    try:
        arguments.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {arguments.out} cannot be made: {error.strerror}; choose another folder") from error
    rng = np.random.default_rng(arguments.seed)
    colours = part_colours(model.tree.names)[model.part_of_vertex]
    pictures = []
    for index in range(arguments.count):
        vertices = model.vertices(model.sample(rng))
        path = arguments.out / f"sp_{model.name}_{index:03d}.ply"
        write_ply(path, vertices, model.faces, colours)
        print(path)
        for looking in VIEWS:
            camera = orthographic(vertices, looking, SIZE, scale=SCALE)
            pictures.append(render(vertices, model.faces, camera, SIZE, colours.astype(np.float64)).rgb)
    sheet = arguments.out / f"sp_{model.name}.png"
    save(contact_sheet(pictures, COLUMNS), sheet)
    print(sheet)
    return 0
