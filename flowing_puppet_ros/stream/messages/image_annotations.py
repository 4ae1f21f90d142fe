# SPDX-License-Identifier: Apache-2.0
"""Puppets in the messages of others: boxes for detection tools (vision_msgs), drawings for Foxglove (foxglove_msgs).

Both put 0, 0 at the outer corner of the first pixel, half a pixel from its centre, where the puppets have it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, partial
from typing import Any

import cv2
import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.draw.overlay import MAX_COORDINATE_PX, DrawnPuppet, is_drawable
from flowing_puppet_ros.draw.palette import joint_colour, part_colours, person_colour
from flowing_puppet_ros.model.ds.joints import PART_JOINTS
from flowing_puppet_ros.stream.messages.geometry import make_pose
from flowing_puppet_ros.stream.messages.message_types import ANNOTATIONS, DETECTIONS_2D, MessageFactory

PERSON = "person"
"""Class of every detection, as COCO names it."""
BONES = (
    *((part[0], part[1]) for part in PART_JOINTS.values()),
    *(("neck", f"{side}_shoulder") for side in ("right", "left")),
    *(("belly", f"{side}_hip") for side in ("right", "left")),
)
"""The pairs of joints that are connected by a line."""
MAX_OUTLINE_ERROR_PX = 0.25
"""Maximum distance of an outline's left-out points from the line that is drawn."""
FILL_OPACITY = 0.2
CERTAIN = 0.5
"""Confidence from which a joint is drawn as a disc; below it is a ring."""
LINE_LOOP, LINE_LIST = 2, 4  # of foxglove_msgs/PointsAnnotation
_VISION, _FOXGLOVE = "vision_msgs/msg/", "foxglove_msgs/msg/"
_POINT = _FOXGLOVE + "Point2"
_CORNER = 0.5  # of a pixel, from its centre
_DARK, _WHITE = (20, 20, 20), (255, 255, 255)

type Rgb = tuple[int, int, int]


def make_detections_2d(factory: MessageFactory, header: Any, puppets: Sequence[Any], size: tuple[int, int]) -> Any:
    """Return the Detection2DArray of the Puppets in an image of `size` (width, height).

    Each has the upright box, in pixels, around all that is known of the person and lies in the image; people without
    any of that are left out.
    """
    boxes = [(puppet, visible_box(DrawnPuppet.from_message(puppet), size)) for puppet in puppets]
    detections = [_make_detection(factory, header, puppet, box) for puppet, box in boxes if box is not None]
    return factory.make(DETECTIONS_2D, header=header, detections=detections)


def _make_detection(factory: MessageFactory, header: Any, puppet: Any, box: Array) -> Any:
    (x, y), (width, height) = (box[0] + box[1]) / 2, box[1] - box[0]
    score = float(np.clip(np.nan_to_num(puppet.confidence), 0, 1))
    hypothesis = factory.make(_VISION + "ObjectHypothesis", class_id=PERSON, score=score)
    # Made in full, since the defaults of a pose differ between the libraries that make messages.
    pose = factory.make(
        "geometry_msgs/msg/PoseWithCovariance",
        pose=make_pose(factory, np.zeros(3), np.eye(3)),
        covariance=np.zeros(36),
    )
    center = factory.make(_VISION + "Pose2D", position=factory.make(_VISION + "Point2D", x=x, y=y))
    return factory.make(
        _VISION + "Detection2D",
        header=header,
        results=[factory.make(_VISION + "ObjectHypothesisWithPose", hypothesis=hypothesis, pose=pose)],
        bbox=factory.make(_VISION + "BoundingBox2D", center=center, size_x=width, size_y=height),
        id=puppet.id,
    )


def visible_box(puppet: DrawnPuppet, size: tuple[int, int]) -> Array | None:
    """Return the corners (2, 2), low and high x and y from the corner of an image of `size` (width, height), or None.

    The box holds outlines and joints, clipped to the image; None when nothing is known or all of it is outside.
    """
    outlines = [contour for contour in puppet.contours if is_drawable(contour)]
    points = np.vstack([*outlines, puppet.joints[_is_known(puppet)]])
    if not len(points):
        return None
    box = np.clip([points.min(axis=0) + _CORNER, points.max(axis=0) + _CORNER], 0, size)
    return np.asarray(box) if (box[0] < box[1]).all() else None


def make_annotations(factory: MessageFactory, header: Any, puppets: Sequence[Any], size: tuple[int, int]) -> Any:
    """Return the ImageAnnotations of the Puppets in an image of `size` (width, height), drawn like the overlay.

    The outlines have the colours of the parts, far ones first, the joints those of the side; the lines between joints
    and the label with the id have the colour of the person.
    """
    drawing = _Drawing(factory, header.stamp, size)
    for puppet in puppets:
        drawing.add(DrawnPuppet.from_message(puppet))
    message = factory.make(ANNOTATIONS, circles=drawing.circles, points=drawing.points, texts=drawing.texts)
    if hasattr(message, "timestamp"):  # versions of foxglove_msgs before 3.2.5 have it in the elements only
        message.timestamp = header.stamp
    return message


class _Drawing:
    """The elements of one message, in the order in which they are drawn."""

    def __init__(self, factory: MessageFactory, stamp: Any, size: tuple[int, int]) -> None:
        self.circles: list[Any] = []
        self.points: list[Any] = []
        self.texts: list[Any] = []
        self._make, self._stamp, self._size = factory.make, stamp, size
        self._color = cache(partial(_make_color, factory))
        self._width = max(1.0, min(size) / 360)

    def add(self, puppet: DrawnPuppet) -> None:
        """Add one person."""
        colours = part_colours(puppet.part_names)
        for index in puppet.order:
            if is_drawable(puppet.contours[index]):
                red, green, blue = (int(value) for value in colours[index])
                self._add_lines(LINE_LOOP, simplify(puppet.contours[index]), (red, green, blue), FILL_OPACITY)
        known = dict(zip(puppet.joint_names, _is_known(puppet), strict=True))
        place = dict(zip(puppet.joint_names, puppet.joints, strict=True))
        bones = [(place[a], place[b]) for a, b in BONES if known.get(a) and known.get(b)]
        if bones:
            self._add_lines(LINE_LIST, np.reshape(bones, (-1, 2)), person_colour(puppet.id), 0.0)
        for name, confidence in zip(puppet.joint_names, puppet.confidence, strict=True):
            if known[name]:
                self._add_joint(place[name], joint_colour(name), float(np.clip(np.nan_to_num(confidence), 0, 1)))
        box = visible_box(puppet, self._size)
        if box is not None:
            self._add_label(puppet.id, box)

    def _point(self, xy: Array) -> Any:
        return self._make_points(xy[None])[0]

    def _make_points(self, points: Array) -> list[Any]:
        return [self._make(_POINT, x=x, y=y) for x, y in points.tolist()]

    def _add_lines(self, kind: int, points: Array, colour: Rgb, fill: float) -> None:
        self.points.append(
            self._make(
                _FOXGLOVE + "PointsAnnotation",
                timestamp=self._stamp,
                type=kind,
                points=self._make_points(points + _CORNER),
                outline_color=self._color(colour, 1.0),
                fill_color=self._color(colour, fill),
                thickness=self._width,
            )
        )

    def _add_joint(self, xy: Array, colour: Rgb, confidence: float) -> None:
        """Add a disc that is larger for more confidence, or a ring."""
        certain = confidence >= CERTAIN
        self.circles.append(
            self._make(
                _FOXGLOVE + "CircleAnnotation",
                timestamp=self._stamp,
                position=self._point(xy + _CORNER),
                diameter=2 * (1.2 + 1.6 * confidence) * self._width,
                thickness=self._width,
                fill_color=self._color(colour if certain else _DARK, 1.0),
                outline_color=self._color(_DARK if certain else colour, 1.0),
            )
        )

    def _add_label(self, text: str, box: Array) -> None:
        """Add the id above the box, or inside where the box touches the top of the image."""
        font_size = max(9.0, min(self._size) / 28)
        bottom = max(font_size, box[0, 1] - 2 * self._width)
        self.texts.append(
            self._make(
                _FOXGLOVE + "TextAnnotation",
                timestamp=self._stamp,
                position=self._point(np.array([box[0, 0], bottom])),
                text=text,
                font_size=font_size,
                text_color=self._color(_WHITE, 1.0),
                background_color=self._color(person_colour(text), 1.0),
            )
        )


def simplify(contour: Array) -> Array:
    """Return a closed outline (K, 2) with fewer points; those left out are within MAX_OUTLINE_ERROR_PX of it."""
    kept = cv2.approxPolyDP(contour.astype(np.float32), MAX_OUTLINE_ERROR_PX, True)
    return np.asarray(kept, float).reshape(-1, 2)


def _is_known(puppet: DrawnPuppet) -> Array:
    """Return which joints (J,) have a position that can be drawn."""
    return np.isfinite(puppet.joints).all(axis=1) & (np.abs(puppet.joints).max(axis=1, initial=0) < MAX_COORDINATE_PX)


def _make_color(factory: MessageFactory, colour: Rgb, opacity: float) -> Any:
    red, green, blue = (value / 255 for value in colour)
    return factory.make(_FOXGLOVE + "Color", r=red, g=green, b=blue, a=opacity)
