# SPDX-License-Identifier: Apache-2.0
"""The fitted bodies drawn over a camera's images, as its lens shows them, at the times of the images.

The clouds that bodies are fitted to rarely have the stamps of the images: each image shows the bodies of the nearest
cloud.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowing_puppet_ros.draw.mesh_render import Canvas
from flowing_puppet_ros.draw.overlay import write_text
from flowing_puppet_ros.draw.pictures import scale_to_height
from flowing_puppet_ros.evaluate.bag.recording import puppet_joints
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.report.pictures.bag_pictures import BodyMesh, ImageBox, crop_camera

MAX_LAG_NS = 350_000_000
"""From an image to the cloud of the bodies that are drawn over it, as `fusion.max_lag` has it."""
PAIR_HEIGHT = 420  # of pictures that stand beside each other, px
MARGIN = 0.06  # around everybody, in shares of the longer side
BODY_OPACITY = 0.65


@dataclass(frozen=True, slots=True, eq=False)
class BodiesAtStamp:
    """The bodies of one cloud: their ids and meshes, in the same order, and the cloud's stamp (ns)."""

    stamp: int
    ids: Sequence[str]
    meshes: Sequence[BodyMesh]


def find_nearest_stamp(stamps: Sequence[int], wanted: int, max_lag: int = MAX_LAG_NS) -> int | None:
    """Return the one of the `stamps` (ns) that is nearest to `wanted`, None where all are farther than `max_lag`."""
    nearest = min(stamps, key=lambda stamp: abs(stamp - wanted), default=None)
    return nearest if nearest is not None and abs(nearest - wanted) <= max_lag else None


def find_everybody_box(
    camera: Camera, bodies: Iterable[BodiesAtStamp], people: Iterable[Sequence[Any]], shape: tuple[int, ...]
) -> ImageBox:
    """Return the part of an image (H, W, ...) that has all `bodies`, and the puppets of all `people`, of all stamps."""
    pixels = [camera.project(mesh.vertices)[0] for each in bodies for mesh in each.meshes]
    joints = [point for persons in people for person in persons for point in puppet_joints(person).values()]
    joined = np.concatenate([*pixels, np.array(joints, float).reshape(-1, 2)])
    return ImageBox.around(np.clip(joined, 0, (shape[1] - 1, shape[0] - 1)), shape, MARGIN)


def draw_bodies(image: np.ndarray, camera: Camera, bodies: BodiesAtStamp | None, box: ImageBox) -> np.ndarray:
    """Draw everybody's mesh with the id above it over the part `box` of an image, PAIR_HEIGHT rows; None: nobody."""
    small = np.ascontiguousarray(scale_to_height(box.crop(image), PAIR_HEIGHT))
    if bodies is None:
        return small
    size = (small.shape[1], small.shape[0])
    shown = crop_camera(camera, box).resize(size)
    canvas = Canvas(shown, size)
    for mesh in bodies.meshes:
        canvas.draw_mesh(mesh.vertices, mesh.faces, mesh.colours)
    picture = np.ascontiguousarray(canvas.compose(small, opacity=BODY_OPACITY).rgb)
    for identity, mesh in zip(bodies.ids, bodies.meshes, strict=True):
        pixels = shown.project(mesh.vertices)[0]
        pixels = pixels[np.isfinite(pixels).all(axis=1)]
        if len(pixels):
            x, y = pixels[:, 0].mean(), pixels[:, 1].min()
            place = np.clip((x - 8, y - 6), (2, 16), (max(size[0] - 30, 2), size[1] - 4))
            write_text(picture, identity, (float(place[0]), float(place[1])), 0.5)
    return picture
