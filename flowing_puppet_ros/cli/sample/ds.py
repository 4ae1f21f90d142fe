# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet sample ds`: a contact sheet of random 2D puppets."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from flowing_puppet_ros.cli.sample.samples import add_common_arguments, draw_samples
from flowing_puppet_ros.draw.overlay import DrawnPuppet, draw_puppets
from flowing_puppet_ros.draw.pictures import make_contact_sheet, save
from flowing_puppet_ros.model.ds.joints import JOINT_NAMES
from flowing_puppet_ros.model.ds.multiview import VIEW_HEADINGS, VIEW_NAMES, MultiViewStructures
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.render import depth_order
from flowing_puppet_ros.model.ds.shape import PuppetShape

PIXELS_PER_METRE = 240.0
MARGIN_PX = 24
COLUMNS = 4  # of the contact sheet
FILES = "ds_GENDER-PARTS.png"
ALL = "all"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `sample ds`."""
    add_common_arguments(parser, FILES)
    parser.add_argument("--parts", type=int, choices=tuple(JOINT_NAMES), default=10, help="parts [%(default)s]")
    views = "side the torso faces, on a map with the camera in the south; all: the likely puppet of every side"
    parser.add_argument("--view", choices=(*VIEW_NAMES, ALL), help=f"{views} [near S]")


def run(arguments: argparse.Namespace) -> int:
    """Draw the samples, print the paths of the files and return the exit status."""
    return draw_samples(arguments, draw)


def draw(arguments: argparse.Namespace, rng: np.random.Generator) -> Iterator[Path]:
    """Draw the puppets on one sheet and yield its path."""
    gender, parts, view = arguments.gender, arguments.parts, arguments.view
    if view is None:
        model = DeformableStructures.load(gender, parts)
        pictures = [draw_picture(model, model.sample(rng)) for _ in range(arguments.count)]
    else:
        sides = MultiViewStructures.load(gender, parts)
        if view == ALL:
            seen = [(side, side.likely_puppet(), angle) for side, angle in zip(sides.views, VIEW_HEADINGS, strict=True)]
        else:
            angle = VIEW_HEADINGS[VIEW_NAMES.index(view)]
            seen = [(sides.at(view), sides.sample(rng, view), angle) for _ in range(arguments.count)]
        pictures = [draw_picture(*one) for one in seen]
    path = arguments.out / f"ds_{gender}-{parts}{'' if view is None else '-' + view}.png"
    save(make_contact_sheet(pictures, len(VIEW_NAMES) if view == ALL else COLUMNS), path)
    yield path


def draw_picture(model: DeformableStructures, shape: PuppetShape, heading: float = 0.0) -> np.ndarray:
    """Draw a puppet in metres, filled in depth order, with contours and joints, on an image that just fits it."""
    points = np.vstack(shape.contours)
    corner = points.min(axis=0) - MARGIN_PX / PIXELS_PER_METRE
    width, height = np.ceil(np.ptp(points, axis=0) * PIXELS_PER_METRE).astype(int) + 2 * MARGIN_PX
    drawn = DrawnPuppet(
        id="",
        joint_names=model.joint_names,
        joints=(shape.joints - corner) * PIXELS_PER_METRE,
        confidence=np.ones(len(model.joint_names)),
        part_names=model.tree.names,
        contours=tuple((contour - corner) * PIXELS_PER_METRE for contour in shape.contours),
        order=depth_order(model, shape.view, heading),
    )
    return draw_puppets(np.full((height, width, 3), 255, np.uint8), [drawn], opacity=0.8, labels=False)
