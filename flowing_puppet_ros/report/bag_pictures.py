# SPDX-License-Identifier: Apache-2.0
"""The report's pictures: tracked puppets, optical and puppet flow, fitted meshes, all small enough for one page."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np

from flowing_puppet_ros.bag.reader import Bag
from flowing_puppet_ros.draw.flow_colour import flow_legend, flow_scale, flow_to_rgb
from flowing_puppet_ros.draw.mesh_render import Canvas, orthographic
from flowing_puppet_ros.draw.overlay import DrawnPuppet, draw_puppets
from flowing_puppet_ros.draw.palette import part_colours
from flowing_puppet_ros.draw.pictures import shrink, to_height
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.evaluate.bag.recording import CameraRecord, body_joints, puppet_joints
from flowing_puppet_ros.flow.estimate import OpticalFlow
from flowing_puppet_ros.flow.puppet_flow import explained_fraction, motion_field, part_motions
from flowing_puppet_ros.model.ds.render import render_labels
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.model.tree import DS14_PARENTS
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.stream.messages.clouds import decode_cloud
from flowing_puppet_ros.stream.messages.geometry import stamp_ns
from flowing_puppet_ros.stream.messages.images import decode_image

STRIP_HEIGHT, FLOW_HEIGHT, VIEW_HEIGHT = 560, 400, 400
BODY_SIZE = (360, 520)
VIEW_ASPECT = 0.75
POINT_COLOUR = (20, 90, 200)


@dataclass(frozen=True, slots=True, eq=False)
class FlowShot:
    """One frame's motion to the next frame: three pictures of one size, and figures."""

    stamp: int
    image: np.ndarray
    flow: np.ndarray
    puppet_flow: np.ndarray
    explained: float
    full_scale: float  # pixels of the working grid that are fully saturated


@dataclass(frozen=True, slots=True, eq=False)
class BodyShot:
    """One stamp's body from the front and from its left, and over the cameras' images [(camera name, picture)]."""

    stamp: int
    front: np.ndarray
    side: np.ndarray
    views: list[tuple[str, np.ndarray]]


def fetch(bag: Bag, wanted: Mapping[str, Iterable[int]]) -> dict[tuple[str, int], Any]:
    """Messages {(topic, stamp)} of the wanted stamps (ns) of each topic; missing and damaged ones are left out."""
    return dict(each(bag, wanted))


def each(bag: Bag, wanted: Mapping[str, Iterable[int]]) -> Iterator[tuple[tuple[str, int], Any]]:
    """Yield ((topic, stamp), message) as `fetch` does, one after the other, so that many images need little memory."""
    stamps = {topic: set(values) for topic, values in wanted.items() if topic}
    for record in bag.messages([topic for topic in stamps if topic in bag.topics]):
        with suppress(InputError):
            message = record.message
            if stamp_ns(message) in stamps[record.topic]:
                yield (record.topic, stamp_ns(message)), message


def spread_over(stamps: Sequence[int], count: int) -> list[int]:
    """At most `count` of the sorted stamps, spread evenly, the first and the last among them."""
    ordered = sorted(stamps)
    if len(ordered) <= count:
        return ordered
    return [ordered[round(k * (len(ordered) - 1) / max(count - 1, 1))] for k in range(count)]


def moving_stamps(camera: CameraRecord, count: int) -> list[int]:
    """The stamp with the fastest puppet in each of `count` equal spans of the recording; each has a successor."""
    stamps = sorted(camera.puppets)
    speed: dict[int, float] = {}
    for stamp, following in pairwise(stamps):
        if camera.puppets[stamp] and camera.puppets[following]:
            now, then = (puppet_joints(camera.puppets[s][0]) for s in (stamp, following))
            common = [name for name in now if name in then]
            speed[stamp] = sum(float(np.linalg.norm(then[name] - now[name])) for name in common)
    chosen = []
    for span in np.array_split(np.array(sorted(speed), np.int64), count):
        if span.size:
            chosen.append(max((int(stamp) for stamp in span), key=lambda stamp: (speed[stamp], -stamp)))
    return chosen


@dataclass(frozen=True, slots=True)
class Box:
    """A part of an image: columns left to right and rows top to bottom, the last ones excluded."""

    left: int
    top: int
    right: int
    bottom: int

    @classmethod
    def around(cls, points: np.ndarray, shape: tuple[int, ...], margin: float, aspect: float = 0.0) -> Box:
        """The box of the finite points (N,2), wider by `margin` times its longer side, inside an image (H,W,...).

        A positive `aspect` is the width by the height that the box is grown to, as far as the image has room.
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

    def scaled(self, factor: float) -> Box:
        """The same part of the image resized by `factor`."""
        left, top = int(self.left * factor), int(self.top * factor)
        right, bottom = (max(low + 1, round(high * factor)) for low, high in ((left, self.right), (top, self.bottom)))
        return Box(left, top, right, bottom)

    def cut(self, image: np.ndarray) -> np.ndarray:
        """That part of an image, a view."""
        return image[self.top : self.bottom, self.left : self.right]


def people_box(people: Iterable[Sequence[Any]], shape: tuple[int, ...], margin: float = 0.14) -> Box:
    """The part of an image (H,W,...) in which the nearest person of the given frames is."""
    joints = [point for persons in people if persons for point in puppet_joints(persons[0]).values()]
    return Box.around(np.array(joints, float).reshape(-1, 2), shape, margin)


def track_shot(image: np.ndarray, people: Sequence[Any], box: Box) -> np.ndarray:
    """The part `box` of an image with its puppets drawn over it, the first with labels; 560 rows."""
    part = box.cut(image)
    small = to_height(part, STRIP_HEIGHT)
    factor = small.shape[0] / part.shape[0]
    drawn = [DrawnPuppet.from_message(person).placed(factor, (box.left, box.top)) for person in people]
    return draw_puppets(draw_puppets(small, drawn[:0:-1], labels=False), drawn[:1])


def flow_shot(stamp: int, image: np.ndarray, following: np.ndarray, people: Sequence[Any], box: Box) -> FlowShot:
    """Dense flow to the following image, and the puppet flow fitted to it under the puppets of `image`.

    The flow is that of the whole image; the pictures show the part `box`.
    """
    forward, backward = OpticalFlow().at_working_scale(image, following)
    height, width = forward.shape[:2]
    factor = height / image.shape[0]
    drawn = [DrawnPuppet.from_message(person).placed(factor) for person in reversed(people)]
    labels, parents = paint_forest([person for person in drawn if person.contours], (height, width))
    motions, background = part_motions(labels, parents, forward, backward)
    field = motion_field(labels, motions.affine, background)
    scale = flow_scale(forward[labels > 0][None] if (labels > 0).any() else forward)
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    outlined = draw_puppets(small, drawn, opacity=0.25, labels=False)
    whole = (outlined, flow_to_rgb(forward, scale), flow_to_rgb(field, scale))
    seen, dense, puppet = (to_height(box.scaled(factor).cut(p), FLOW_HEIGHT) for p in whole)
    size = min(dense.shape[:2]) // 5
    dense[-size:, -size:] = flow_legend(size)
    return FlowShot(stamp, seen, dense, puppet, explained_fraction(labels, field, forward), scale)


def paint_forest(people: Sequence[DrawnPuppet], shape: tuple[int, int]) -> tuple[np.ndarray, tuple[int, ...]]:
    """Labels (H,W) uint16 of all people's parts, running part index + 1, and the parents of the running indices."""
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
    """A fitted mesh with a colour per vertex, and what it was fitted to."""

    vertices: np.ndarray  # (V,3) metres, z up
    faces: np.ndarray  # (F,3)
    colours: np.ndarray  # (V,3)
    points: np.ndarray  # (N,3), may be empty


def body_meshes(bodies: Sequence[Any], vertices: Any, triangles: np.ndarray, cloud: Any | None) -> list[BodyMesh]:
    """The meshes of a stamp's bodies from its messages: the cloud of all their vertices, and what they were fitted to.

    Empty when the cloud of the vertices is missing or is not one body after the other.
    """
    if vertices is None or not len(triangles) or not bodies:
        return []
    count = int(triangles.max()) + 1
    places = decode_cloud(vertices)[0]
    if len(places) < count * len(bodies):
        return []
    points = decode_cloud(cloud)[0] if cloud is not None else np.zeros((0, 3))
    return [
        BodyMesh(places[count * k : count * (k + 1)], triangles, _colours(body, count), points)
        for k, body in enumerate(bodies)
    ]


def _colours(body: Any, count: int) -> np.ndarray:
    """Colours (V, 3) of the parts; a body of a model that is not installed here is grey."""
    with suppress(PuppetError):
        model = StitchedPuppet.load(body.model)
        if len(model.part_of_vertex) == count:
            return part_colours(model.tree.names)[model.part_of_vertex].astype(float)
    return np.full((count, 3), 205.0)


def body_shot(stamp: int, body: Any, mesh: BodyMesh, images: Sequence[tuple[str, Camera, np.ndarray]]) -> BodyShot:
    """Draw a body from two sides and over (camera name, camera, image)."""
    forward, left, up = facing(body_joints(body))
    front, side = (_from_side(mesh, -direction, up) for direction in (forward, left))
    views = []
    for name, camera, image in images:
        box = Box.around(camera.project(mesh.vertices)[0], image.shape, 0.08, VIEW_ASPECT)
        small = shrink(box.cut(image), VIEW_HEIGHT)
        size = (small.shape[1], small.shape[0])
        canvas = Canvas(_cropped(camera, box).resized(size), size)
        canvas.mesh(mesh.vertices, mesh.faces, mesh.colours)
        views.append((name, canvas.picture(small, opacity=0.7).rgb))
    return BodyShot(stamp, front, side, views)


def _cropped(camera: Camera, box: Box) -> Camera:
    matrix = camera.matrix.copy()
    matrix[:2, 2] -= (box.left, box.top)
    return replace(camera, matrix=matrix, size=(box.right - box.left, box.bottom - box.top))


def facing(joints: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors to the person's front and left and upwards, from shoulders and hips; x, y and z when unknown.

    Up is z, unless the trunk is nearer to lying in a z-up frame: then the axis nearest to the trunk, as in clouds in
    the frame of an optical sensor (y down).
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


def _from_side(mesh: BodyMesh, looking: np.ndarray, up: np.ndarray) -> np.ndarray:
    across = np.cross(looking, up)
    height = float(np.ptp(mesh.vertices @ up))
    reach = max(float(np.ptp(mesh.vertices @ direction)) for direction in (across, looking))
    scale = 0.88 * min(BODY_SIZE[1] / max(height, 1e-3), BODY_SIZE[0] / max(reach, 1e-3))
    canvas = Canvas(orthographic(mesh.vertices, looking, BODY_SIZE, up, scale=scale), BODY_SIZE)
    canvas.mesh(mesh.vertices, mesh.faces, mesh.colours)
    if len(mesh.points):
        canvas.points(mesh.points, POINT_COLOUR, radius=0.9)
    return canvas.picture((250, 250, 250)).rgb


def picture_of(messages: Mapping[tuple[str, int], Any], topic: str, stamp: int) -> np.ndarray | None:
    """The RGB image of a fetched message, None when it is not there."""
    message = messages.get((topic, stamp))
    return None if message is None else decode_image(message)
