# SPDX-License-Identifier: Apache-2.0
"""Puppets for the page: a new one, those found in the image, the outline of one, and one moved by the flow."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from flowing_puppet_ros.annotate.store import Person
from flowing_puppet_ros.arrays import U8
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.flow.estimate import OpticalFlow
from flowing_puppet_ros.image.detector.part_detector import DEFAULT_SETTINGS, PartDetector
from flowing_puppet_ros.image.formats.keypoints import Keypoints, joints_from_keypoints
from flowing_puppet_ros.image.networks.keypoint_networks import KeypointSource
from flowing_puppet_ros.image.tracking.settings import TrackerSettings
from flowing_puppet_ros.image.tracking.tracker import FlowingPuppetTracker
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.render import depth_order
from flowing_puppet_ros.model.ds.shape import View

MIN_PROBABILITY = 0.3  # of a person whom the own detector finds
START_HEIGHT_SHARE = 0.9  # of the image, covered by a new puppet's trunk, head and arms


@cache
def load_model(gender: str, parts: int) -> DeformableStructures:
    """Load the body model of a gender, once."""
    return DeformableStructures.load(gender, parts)


def make_person(parts: int, gender: str, view: View, size: tuple[int, int]) -> Person:
    """Make a person in the middle of an image of `size` (width, height): upper body inside, legs below."""
    model = load_model(gender, parts)
    joints = model.mean_joints() * (1 if view == "front" else -1, 1)
    upper = joints[[k for k, name in enumerate(model.joint_names) if not name.endswith(("knee", "ankle", "foot"))]]
    low, high = upper.min(axis=0), upper.max(axis=0)
    scale = START_HEIGHT_SHARE * float(min(np.array(size) / (high - low + 0.3)))
    placed = (joints - (low + high) / 2) * scale + np.array(size) / 2
    return {"joints": [[*map(float, joint), 1] for joint in placed], "gender": gender, "view": view}


def find_people(parts: int, image: U8, networks: KeypointSource | None) -> list[Person]:
    """Find people in an image (H, W, 3) as a first guess, by `networks` or else the package's own detector.

    Joints that nobody saw are where the model puts them, marked as not visible.
    """
    model = load_model("neutral", parts)
    people: list[Person] = []
    for keypoints in _detect(image, networks):
        joints, confidence = joints_from_keypoints(model, keypoints)
        known = np.isfinite(joints).all(axis=1)
        try:
            scale, view = model.estimate_scale(joints, confidence), model.estimate_view(joints, confidence)
            placed = model.complete_joints(joints, confidence, scale, view)
        except InputError:
            continue
        rows = [[*map(float, xy), int(seen)] for xy, seen in zip(placed, known, strict=True)]
        people.append({"joints": rows, "gender": "neutral", "view": view})
    return people


def _detect(image: U8, networks: KeypointSource | None) -> list[Keypoints]:
    if networks is not None:
        return [person.keypoints for person in networks.find(image)]
    found = PartDetector.load().detect(image, DEFAULT_SETTINGS)
    return [person.keypoints for person in found if person.confidence >= MIN_PROBABILITY]


def draw_outline(parts: int, person: Person) -> dict[str, Any]:
    """Return the contours of the most probable puppet on a person's joints, in paint order (Eqs. 23-30).

    InputError when the joints cannot be a person's, for example all in one place.
    """
    model = load_model(person["gender"], parts)
    given = np.array(person["joints"], dtype=np.float64)
    scale = model.estimate_scale(given[:, :2], np.where(given[:, 2] > 0, 1.0, 0.3))
    shape = model.puppet_from_joints(given[:, :2], scale, person["view"])
    painted = [
        {"part": model.tree.names[part], "contour": np.round(shape.contours[part], 1).tolist()}
        for part in depth_order(model, person["view"])
    ]
    return {"scale": scale, "parts": painted}


def propagate_people(parts: int, people: list[Person], previous: U8, image: U8) -> list[Person]:
    """Propagate people by puppet flow from the previous image to `image`, both (H, W, 3).

    InputError when the images differ in size or are too small for optical flow.
    """
    if previous.shape != image.shape:
        raise InputError("the previous image has another size; puppets can be copied between images of one size only")
    flow = OpticalFlow().estimate_at_working_scale(previous, image)
    propagated = []
    for person in people:
        model = load_model(person["gender"], parts)
        tracker = FlowingPuppetTracker(model, TrackerSettings())
        joints = np.array(person["joints"], dtype=np.float64)
        given = Keypoints(model.joint_names, joints[:, :2], np.ones(len(joints)))
        tracker.step(previous, 0, [given])
        puppets = tracker.step(image, 1, flow=flow).puppets
        if puppets:
            joints_now = np.where(np.isfinite(puppets[0].joints), puppets[0].joints, joints[:, :2])
            propagated.append(
                person | {"joints": [[*map(float, xy), int(v)] for xy, v in zip(joints_now, joints[:, 2], strict=True)]}
            )
    return propagated
