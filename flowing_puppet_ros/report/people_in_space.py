# SPDX-License-Identifier: Apache-2.0
"""The report's section on people whom several cameras see: all cameras at some moments, joints in space, agreement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from flowing_puppet_ros.bag.reader import Bag
from flowing_puppet_ros.draw.palette import list_person_colours
from flowing_puppet_ros.draw.pictures import scale_to_height
from flowing_puppet_ros.draw.plots import Series, draw_line_plot
from flowing_puppet_ros.evaluate.bag.recording import CameraRecord, Joints, Recording
from flowing_puppet_ros.evaluate.bag.reprojection import (
    PeopleInSpace,
    Reprojection,
    measure_reprojection,
    read_people_in_space,
)
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.report.page import figure, paragraph, row, table
from flowing_puppet_ros.report.pictures.bag_pictures import ImageBox, decode_picture, fetch_messages, pick_evenly

_MOMENTS, _MAX_CAMERAS = 3, 8
_HEIGHT = 400  # of the pictures, px
_MARGIN = 0.12  # around the people, in shares of their extent
_PLOTTED = ("neck", "left_wrist", "right_wrist", "left_ankle", "right_ankle")
_TRUNK = ("left_shoulder", "right_shoulder", "right_hip", "left_hip")
_LIMBS = (
    *(
        (f"{side}_{a}", f"{side}_{b}")
        for side in ("left", "right")
        for a, b in (("shoulder", "elbow"), ("elbow", "wrist"))
    ),
    *((f"{side}_{a}", f"{side}_{b}") for side in ("left", "right") for a, b in (("hip", "knee"), ("knee", "ankle"))),
    *(("neck", "face"), *zip(_TRUNK, (*_TRUNK[1:], _TRUNK[0]), strict=True)),
)


@dataclass(frozen=True, slots=True, eq=False)
class SpaceData:
    """People in space over time, their distances from the puppets by camera, and (stamp, pictures by camera)."""

    people: PeopleInSpace
    reprojection: dict[str, Reprojection]
    moments: list[tuple[int, dict[str, np.ndarray]]]

    @property
    def ids(self) -> list[str]:
        """Everybody's id, in the order in which they come."""
        return _list_ids(self.people)


def gather_space(recording: Recording, given: Bag, made: Bag) -> SpaceData | None:
    """Gather the people in space of a replay; None if its output has none."""
    people = read_people_in_space(made)
    if not people:
        return None
    cameras = [c for c in recording.cameras.values() if c.camera is not None and c.image_topic][:_MAX_CAMERAS]
    most = max(map(len, people.values()))
    colours = list_person_colours(_list_ids(people))
    stamps = pick_evenly([stamp for stamp, group in people.items() if len(group) == most], _MOMENTS)
    images = fetch_messages(given, {camera.image_topic: stamps for camera in cameras})
    moments = []
    for stamp in stamps:
        pictures = {}
        for record in cameras:
            image = decode_picture(images, record.image_topic, stamp)
            if image is not None:
                pictures[record.name] = _draw_people(image, record, people[stamp], colours)
        if pictures:
            moments.append((stamp, pictures))
    return SpaceData(people, measure_reprojection(recording, people), moments)


def _list_ids(people: PeopleInSpace) -> list[str]:
    """Return everybody's id, in the order in which they come."""
    return list(dict.fromkeys(identity for stamp in sorted(people) for identity in people[stamp]))


def _draw_people(
    image: np.ndarray, record: CameraRecord, people: Mapping[str, Joints], colours: Mapping[str, tuple[int, int, int]]
) -> np.ndarray:
    """Draw the projected joints of everybody in the colours of their ids over the part of the image with them."""
    camera = record.camera
    assert camera is not None
    projected = {identity: _project(camera, joints) for identity, joints in people.items()}
    points = np.array([point for each in projected.values() for point in each.values()], float).reshape(-1, 2)
    box = ImageBox.around(points, image.shape, _MARGIN)
    canvas = np.ascontiguousarray(scale_to_height(box.crop(image), _HEIGHT))
    factor = canvas.shape[0] / (box.bottom - box.top)
    for identity, each in projected.items():
        colour = colours[identity]
        pixels = {
            name: (round((p[0] - box.left) * factor), round((p[1] - box.top) * factor))
            for name, p in each.items()
            if np.isfinite(p).all() and np.abs(p).max() < 1e5
        }
        for one, other in _LIMBS:
            if one in pixels and other in pixels:
                cv2.line(canvas, pixels[one], pixels[other], colour, 2, cv2.LINE_AA)
        for name, pixel in pixels.items():
            cv2.circle(canvas, pixel, 4, colour, -1 if name.startswith("left_") else 1, cv2.LINE_AA)
        if "neck" in pixels:
            cv2.putText(canvas, identity, pixels["neck"], cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, 2, cv2.LINE_AA)
    return canvas


def _project(camera: Camera, joints: Joints) -> Joints:
    return {name: camera.project(point)[0] for name, point in joints.items()}


def make_space_section(space: SpaceData, start: int) -> str:
    """Make the section: pictures of all cameras, the agreement by camera, and heights of joints over time."""
    html = paragraph(
        f"Joints on which two or more cameras agree, of {', '.join(space.ids)}, projected into every camera; one "
        "colour a person, dots of the left side are filled."
    )
    for stamp, pictures in space.moments:
        when = f"{(stamp - start) * 1e-9:.2f} s"
        shown = [figure(image, f"People in {name} at {when}", name) for name, image in pictures.items()]
        html += f"<h3>{when}</h3>" + row(shown, "views")
    if space.reprojection:
        html += _make_agreement_table(space)
    for identity in space.ids:
        plot = draw_line_plot(_make_heights(space, identity, start), f"Joints of {identity}", "time [s]", "height [m]")
        html += f"<h3>Heights of the joints of {identity}</h3>{plot}" if plot else ""
    return html


def _make_agreement_table(space: SpaceData) -> str:
    rows = []
    for name, each in (*space.reprojection.items(), ("all cameras", Reprojection.join(space.reprojection))):
        rows.append(
            (
                name,
                f"{each.mean_of_agreeing:.1f}",
                f"{100 * each.agrees.mean():.0f} %",
                f"{np.median(each.pixels):.1f}",
                f"{each.pixels.mean():.1f}",
                str(len(each.pixels)),
            )
        )
    heads = ("camera", "mean px where they agree", "that agree", "median px of all", "mean px of all", "joints")
    caption = (
        "Joints in space, projected, against the joints of the puppets. A camera agrees on a joint within 6 cm; one "
        "that does not has guessed a hidden limb, or its calibration is off."
    )
    return table(heads, rows, range(1, 6), caption)


def _make_heights(space: SpaceData, identity: str, start: int) -> list[Series]:
    stamps = sorted(space.people)
    seconds = (np.array(stamps) - start) * 1e-9
    nothing = np.full(3, np.nan)
    return [
        Series(
            name.replace("_", " "),
            seconds,
            np.array([space.people[s].get(identity, {}).get(name, nothing)[2] for s in stamps], float),
        )
        for name in _PLOTTED
    ]
