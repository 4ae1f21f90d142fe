# SPDX-License-Identifier: Apache-2.0
"""The report's pictures: tracked puppets, optical and puppet flow, fitted meshes, small enough for one page."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np

from flowing_puppet_ros.bag.reader import Bag
from flowing_puppet_ros.draw.flow_colour import draw_flow_legend, flow_scale, flow_to_rgb
from flowing_puppet_ros.draw.mesh_render import Canvas, fit_orthographic_camera
from flowing_puppet_ros.draw.overlay import DrawnPuppet, draw_puppets
from flowing_puppet_ros.draw.palette import part_colours
from flowing_puppet_ros.draw.pictures import scale_to_height, shrink
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.evaluate.bag.recording import CameraRecord, body_joints, puppet_joints
from flowing_puppet_ros.flow.estimate import OpticalFlow
from flowing_puppet_ros.flow.puppet_flow import explained_fraction, fit_part_motions, motion_field
from flowing_puppet_ros.model.ds.render import render_labels
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.model.tree import DS14_PARENTS
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.stream.messages.clouds import decode_cloud
from flowing_puppet_ros.stream.messages.geometry import stamp_ns
from flowing_puppet_ros.stream.messages.images import decode_image

STRIP_HEIGHT, FLOW_HEIGHT, VIEW_HEIGHT = 560, 400, 400  # px of track, flow and body pictures
BODY_SIZE = (360, 520)  # px, width and height of a body alone
VIEW_ASPECT = 0.75  # width by height of a body over an image
POINT_COLOUR = (20, 90, 200)
PALE_SHARE = 0.6  # of white in the colour of a part that was not seen


@dataclass(frozen=True, slots=True, eq=False)
class FlowShot:
    """One frame's motion to the next frame: three pictures of the same size, and figures."""

    stamp: int
    image: np.ndarray
    flow: np.ndarray
    puppet_flow: np.ndarray
    explained: float
    full_scale: float  # pixels of the working grid that are fully saturated


@dataclass(frozen=True, slots=True, eq=False)
class BodyShot:
    """One body from the front and from its left, and over the cameras' images [(camera name, picture)]."""

    stamp: int
    front: np.ndarray
    side: np.ndarray
    views: list[tuple[str, np.ndarray]]


def fetch_messages(bag: Bag, wanted: Mapping[str, Iterable[int]]) -> dict[tuple[str, int], Any]:
    """Return {(topic, stamp): message} for the wanted stamps (ns) of each topic, without missing and damaged ones."""
    return dict(read_messages(bag, wanted))


def read_messages(bag: Bag, wanted: Mapping[str, Iterable[int]]) -> Iterator[tuple[tuple[str, int], Any]]:
    """Yield ((topic, stamp), message) of `fetch_messages` one by one, so that many images need little memory."""
    stamps = {topic: set(values) for topic, values in wanted.items() if topic}
    for record in bag.messages([topic for topic in stamps if topic in bag.topics]):
        with suppress(InputError):
            message = record.message
            if stamp_ns(message) in stamps[record.topic]:
                yield (record.topic, stamp_ns(message)), message


def pick_evenly(stamps: Sequence[int], count: int) -> list[int]:
    """Return at most `count` of the stamps, sorted and evenly spread, with the first and the last."""
    ordered = sorted(stamps)
    if len(ordered) <= count:
        return ordered
    return [ordered[round(k * (len(ordered) - 1) / max(count - 1, 1))] for k in range(count)]


def find_moving_stamps(camera: CameraRecord, count: int) -> list[int]:
    """Return the stamp with the fastest puppet in each of `count` equal spans of the recording, never the last one."""
    stamps = sorted(camera.puppets)
    speed: dict[int, float] = {}
    for stamp, following in pairwise(stamps):
        if camera.puppets[stamp] and camera.puppets[following]:
            now, later = (puppet_joints(camera.puppets[s][0]) for s in (stamp, following))
            common = [name for name in now if name in later]
            speed[stamp] = sum(float(np.linalg.norm(later[name] - now[name])) for name in common)
    chosen = []
    for span in np.array_split(np.array(sorted(speed), np.int64), count):
        if span.size:
            chosen.append(max((int(stamp) for stamp in span), key=lambda stamp: (speed[stamp], -stamp)))
    return chosen


@dataclass(frozen=True, slots=True)
class ImageBox:
    """A part of an image: columns left to right and rows top to bottom, the last ones exclusive."""

    left: int
    top: int
    right: int
    bottom: int

    @classmethod
    def around(cls, points: np.ndarray, shape: tuple[int, ...], margin: float, aspect: float = 0.0) -> ImageBox:
        """Return the box of the finite `points` (N, 2) within an image (H, W, ...).

        It is enlarged by `margin` times its longer side on each side and, with a positive `aspect`, to that ratio of
        width to height, as far as the image has room.
        """
        points = points[np.isfinite(points).all(axis=1)]
        room = np.array(shape[1::-1], float)
        if not len(points):
            return cls(0, 0, int(room[0]), int(room[1]))
        low, high = points.min(axis=0), points.max(axis=0)
        size = high - low + 2 * margin * float((high - low).max())
        if aspect > 0:
            size = np.maximum(size, [size[1] * aspect, size[0] / aspect])
        size = np.clip(np.ceil(size), 2, room)
        left, top = (int(value) for value in np.clip(np.floor((low + high - size) / 2), 0, room - size))
        return cls(left, top, left + int(size[0]), top + int(size[1]))

    def scale(self, factor: float) -> ImageBox:
        """Return the box in the image resized by `factor`."""
        left, top = int(self.left * factor), int(self.top * factor)
        right, bottom = (max(low + 1, round(high * factor)) for low, high in ((left, self.right), (top, self.bottom)))
        return ImageBox(left, top, right, bottom)

    def crop(self, image: np.ndarray) -> np.ndarray:
        """Return this part of an image, a view."""
        return image[self.top : self.bottom, self.left : self.right]


def find_people_box(people: Iterable[Sequence[Any]], shape: tuple[int, ...], margin: float = 0.14) -> ImageBox:
    """Return the part of an image (H, W, ...) that has the nearest person of the given frames."""
    joints = [point for persons in people if persons for point in puppet_joints(persons[0]).values()]
    return ImageBox.around(np.array(joints, float).reshape(-1, 2), shape, margin)


def draw_track(image: np.ndarray, people: Sequence[Any], box: ImageBox, height: int = STRIP_HEIGHT) -> np.ndarray:
    """Draw the puppets over the part `box` of an image, the first one with labels; `height` rows."""
    part = box.crop(image)
    small = scale_to_height(part, height)
    factor = small.shape[0] / part.shape[0]
    drawn = [DrawnPuppet.from_message(person).transform(factor, (box.left, box.top)) for person in people]
    return draw_puppets(draw_puppets(small, drawn[:0:-1], labels=False), drawn[:1])


def draw_flow_shot(
    stamp: int, image: np.ndarray, following: np.ndarray, people: Sequence[Any], box: ImageBox
) -> FlowShot:
    """Draw the dense flow to the following image, and the puppet flow fitted to it under the puppets of `image`.

    The flow is that of the whole image; the pictures show the part `box`.
    """
    forward, backward = OpticalFlow().estimate_at_working_scale(image, following)
    height, width = forward.shape[:2]
    factor = height / image.shape[0]
    drawn = [DrawnPuppet.from_message(person).transform(factor) for person in reversed(people)]
    labels, parents = render_people_labels([person for person in drawn if person.contours], (height, width))
    motions, background = fit_part_motions(labels, parents, forward, backward)
    field = motion_field(labels, motions.affine, background)
    scale = flow_scale(forward[labels > 0][None] if (labels > 0).any() else forward)
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    outlined = draw_puppets(small, drawn, opacity=0.25, labels=False)
    pictures = (outlined, flow_to_rgb(forward, scale), flow_to_rgb(field, scale))
    overlay, dense, puppet = (scale_to_height(box.scale(factor).crop(p), FLOW_HEIGHT) for p in pictures)
    size = min(dense.shape[:2]) // 5
    dense[-size:, -size:] = draw_flow_legend(size)
    return FlowShot(stamp, overlay, dense, puppet, explained_fraction(labels, field, forward), scale)


def render_people_labels(people: Sequence[DrawnPuppet], shape: tuple[int, int]) -> tuple[np.ndarray, tuple[int, ...]]:
    """Return labels (H, W) uint16 of all people's parts, running index + 1, and the parent of each running index."""
    labels = np.zeros(shape, np.uint16)
    parents: list[int] = []
    for person in people:
        first = len(parents)
        own = render_labels(person.contours, person.order, shape)
        labels = np.where(own > 0, own.astype(np.uint16) + np.uint16(first), labels)
        for name in person.part_names:
            parent = DS14_PARENTS.get(name)
            parents.append(first + person.part_names.index(parent) if parent in person.part_names else -1)
    return labels, tuple(parents)


@dataclass(frozen=True, slots=True, eq=False)
class BodyMesh:
    """A fitted mesh with a colour per vertex, and the points it was fitted to."""

    vertices: np.ndarray  # (V, 3) metres, z up
    faces: np.ndarray  # (F, 3)
    colours: np.ndarray  # (V, 3)
    points: np.ndarray  # (N, 3), may be empty


def list_meshed(bodies: Sequence[Any]) -> list[Any]:
    """Return the Body messages that have a mesh: people whom colour alone shows have joints only."""
    return [body for body in bodies if body.parts]


def read_body_meshes(bodies: Sequence[Any], vertices: Any, triangles: np.ndarray, cloud: Any | None) -> list[BodyMesh]:
    """Return the meshes of `bodies` from the clouds of all their `vertices` and of the points they were fitted to.

    Empty if the cloud of vertices is missing or too small for all bodies, one after the other.
    """
    if vertices is None or not len(triangles) or not bodies:
        return []
    count = int(triangles.max()) + 1
    positions = decode_cloud(vertices)[0]
    if len(positions) < count * len(bodies):
        return []
    points = decode_cloud(cloud)[0] if cloud is not None else np.zeros((0, 3))
    return [
        BodyMesh(positions[count * k : count * (k + 1)], triangles, _vertex_colours(body, count), points)
        for k, body in enumerate(bodies)
    ]


def _vertex_colours(body: Any, count: int) -> np.ndarray:
    """Return colours (V, 3) by part, pale where it was not seen; grey for a model that is not installed here."""
    with suppress(PuppetError):
        model = StitchedPuppet.load(body.model)
        if len(model.part_of_vertex) == count:
            colours = part_colours(model.tree.names).astype(float)
            # A recording of an older version says nothing of visibility.
            unseen = [getattr(part, "visibility", 1) == 0 for part in body.parts]
            if len(unseen) == len(colours):
                colours[unseen] += PALE_SHARE * (255.0 - colours[unseen])
            return colours[model.part_of_vertex]
    return np.full((count, 3), 205.0)


def draw_body_shot(stamp: int, body: Any, mesh: BodyMesh, images: Sequence[tuple[str, Camera, np.ndarray]]) -> BodyShot:
    """Draw a body from two sides and over (camera name, camera, image)."""
    forward, left, up = body_axes(body_joints(body))
    front, side = (_render_side(mesh, -direction, up) for direction in (forward, left))
    views = []
    for name, camera, image in images:
        box = ImageBox.around(camera.project(mesh.vertices)[0], image.shape, 0.08, VIEW_ASPECT)
        small = shrink(box.crop(image), VIEW_HEIGHT)
        size = (small.shape[1], small.shape[0])
        canvas = Canvas(crop_camera(camera, box).resize(size), size)
        canvas.draw_mesh(mesh.vertices, mesh.faces, mesh.colours)
        views.append((name, canvas.compose(small, opacity=0.7).rgb))
    return BodyShot(stamp, front, side, views)


def crop_camera(camera: Camera, box: ImageBox) -> Camera:
    """Return the camera of the part `box` of a camera's image."""
    matrix = camera.matrix.copy()
    matrix[:2, 2] -= (box.left, box.top)
    return replace(camera, matrix=matrix, size=(box.right - box.left, box.bottom - box.top))


def body_axes(joints: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return unit vectors to the person's front, left and up from shoulders and hips; x, y and z when unknown.

    Up is z if the trunk is clearly upright in a z-up frame, otherwise the axis nearest to the trunk, as for clouds in
    an optical frame (y down).
    """
    x, y, z = np.eye(3)
    sides = {f"{side}_{joint}" for side in ("left", "right") for joint in ("shoulder", "hip")}
    if not sides <= set(joints):
        return x, y, z
    shoulders, hips = ([joints[f"{side}_{joint}"] for side in ("left", "right")] for joint in ("shoulder", "hip"))
    trunk = shoulders[0] + shoulders[1] - hips[0] - hips[1]
    nearest = int(np.abs(trunk).argmax())
    up = z if trunk[2] > 0.3 * np.linalg.norm(trunk) else np.sign(trunk[nearest]) * np.eye(3)[nearest]
    left = shoulders[0] - shoulders[1] + hips[0] - hips[1]
    left = left - (left @ up) * up
    length = float(np.linalg.norm(left))
    if not length > 1e-6:
        return x, y, z
    return np.cross(left / length, up), left / length, up


def _render_side(mesh: BodyMesh, direction: np.ndarray, up: np.ndarray) -> np.ndarray:
    across = np.cross(direction, up)
    height = float(np.ptp(mesh.vertices @ up))
    extent = max(float(np.ptp(mesh.vertices @ axis)) for axis in (across, direction))
    scale = 0.88 * min(BODY_SIZE[1] / max(height, 1e-3), BODY_SIZE[0] / max(extent, 1e-3))
    canvas = Canvas(fit_orthographic_camera(mesh.vertices, direction, BODY_SIZE, up, scale=scale), BODY_SIZE)
    canvas.draw_mesh(mesh.vertices, mesh.faces, mesh.colours)
    if len(mesh.points):
        canvas.draw_points(mesh.points, POINT_COLOUR, radius=0.9)
    return canvas.compose((250, 250, 250)).rgb


def decode_picture(messages: Mapping[tuple[str, int], Any], topic: str, stamp: int) -> np.ndarray | None:
    """Return the RGB image of a fetched message, None if it is missing."""
    message = messages.get((topic, stamp))
    return None if message is None else decode_image(message)
