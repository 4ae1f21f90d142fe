# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet sample ds`: a contact sheet of random 2D puppets."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.ds import DeformableStructures
from flowing_puppet_ros.model.ds_joints import JOINT_NAMES
from flowing_puppet_ros.model.ds_render import depth_order
from flowing_puppet_ros.model.ds_shape import PuppetShape
from flowing_puppet_ros.view.overlay import DrawnPuppet, draw_puppets
from flowing_puppet_ros.view.pictures import contact_sheet, save

SCALE = 240.0  # pixels per metre
MARGIN = 24  # pixels
COLUMNS = 4


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of `sample ds`."""
    parser.add_argument("--gender", default="neutral", help="neutral, female or male [%(default)s]")
    parser.add_argument("--parts", type=int, choices=tuple(JOINT_NAMES), default=10, help="parts [%(default)s]")
    parser.add_argument("--count", type=int, default=8, help="puppets [%(default)s]")
    parser.add_argument("--seed", type=int, default=0, help="seed of the samples [%(default)s]")
    parser.add_argument("--out", type=Path, required=True, help="folder for ds_GENDER-PARTS.png")


def run(arguments: argparse.Namespace) -> int:
    """Draw the samples and print the path of the sheet."""
    if arguments.count < 1:
        raise InputError(f"--count is {arguments.count}; draw at least 1")
    if arguments.seed < 0:
        raise InputError(f"--seed is {arguments.seed}; it must be 0 or more")
    model = DeformableStructures.load(arguments.gender, arguments.parts)
    rng = np.random.default_rng(arguments.seed)
    pictures = [picture(model, model.sample(rng)) for _ in range(arguments.count)]
    try:
        arguments.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {arguments.out} cannot be made: {error.strerror}; choose another folder") from error
    path = arguments.out / f"ds_{model.name}.png"
    save(contact_sheet(pictures, COLUMNS), path)
    print(path)
    return 0


def picture(model: DeformableStructures, shape: PuppetShape) -> np.ndarray:
    """Draw a puppet of model space, filled in depth order, with contours and joints, on an image that it just fits."""
    points = np.vstack(shape.contours)
    corner = points.min(axis=0) - MARGIN / SCALE
    width, height = np.ceil(np.ptp(points, axis=0) * SCALE).astype(int) + 2 * MARGIN
    drawn = DrawnPuppet(
        id="",
        joint_names=model.joint_names,
        joints=(shape.joints - corner) * SCALE,
        confidence=np.ones(len(model.joint_names)),
        part_names=model.tree.names,
        contours=tuple((contour - corner) * SCALE for contour in shape.contours),
        order=depth_order(model, shape.view),
    )
    return draw_puppets(np.full((height, width, 3), 255, np.uint8), [drawn], opacity=0.8, labels=False)
