# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet sample ds`: a contact sheet of random 2D puppets."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from flowing_puppet_ros.model.ds import DeformableStructures
from flowing_puppet_ros.model.ds_joints import JOINT_NAMES
from flowing_puppet_ros.model.ds_render import depth_order
from flowing_puppet_ros.model.ds_shape import PuppetShape
from flowing_puppet_ros.view.overlay import DrawnPuppet, draw_puppets
from flowing_puppet_ros.view.pictures import contact_sheet, save

SCALE = 240.0  # pixels per metre
MARGIN = 24  # pixels
COLUMNS = 4
FILES = "ds_GENDER-PARTS.png"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of `sample ds` alone."""
    parser.add_argument("--parts", type=int, choices=tuple(JOINT_NAMES), default=10, help="parts [%(default)s]")


def draw(arguments: argparse.Namespace, rng: np.random.Generator) -> Iterator[Path]:
    """Draw the puppets on one sheet and yield its path."""
    model = DeformableStructures.load(arguments.gender, arguments.parts)
    pictures = [picture(model, model.sample(rng)) for _ in range(arguments.count)]
    path = arguments.out / f"ds_{model.name}.png"
    save(contact_sheet(pictures, COLUMNS), path)
    yield path


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
