# SPDX-License-Identifier: Apache-2.0
"""What the page asks of the body model: a puppet to begin with, the outline of a posed one, one carried by the flow."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from flowing_puppet_ros.annotate.store import Person
from flowing_puppet_ros.arrays import U8
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.flow.estimate import OpticalFlow
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.tracking.track import TrackerSettings
from flowing_puppet_ros.image.tracking.tracker import FlowingPuppetTracker
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.render import depth_order
from flowing_puppet_ros.model.ds.shape import View

START_HEIGHT = 0.9  # of the image that a new puppet's trunk, head and arms take


@cache
def body(gender: str, parts: int) -> DeformableStructures:
    """The body model of a gender."""
    return DeformableStructures.load(gender, parts)


def new_person(parts: int, gender: str, view: View, size: tuple[int, int]) -> Person:
    """A person in the middle of an image of `size` (width, height), upper body inside it, legs below."""
    model = body(gender, parts)
    joints = model.mean_joints() * (1 if view == "front" else -1, 1)
    upper = joints[[k for k, name in enumerate(model.joint_names) if not name.endswith(("knee", "ankle", "foot"))]]
    low, high = upper.min(axis=0), upper.max(axis=0)
    scale = START_HEIGHT * float(min(np.array(size) / (high - low + 0.3)))
    placed = (joints - (low + high) / 2) * scale + np.array(size) / 2
    return {"joints": [[*map(float, joint), 1] for joint in placed], "gender": gender, "view": view}


def outline(parts: int, person: Person) -> dict[str, Any]:
    """Contours of the most probable puppet on a person's joints, in the order in which they are painted (Eqs. 23-30).

    InputError when the joints cannot be a person's, say all in one place.
    """
    model = body(person["gender"], parts)
    given = np.array(person["joints"], dtype=np.float64)
    scale = model.estimate_scale(given[:, :2], np.where(given[:, 2] > 0, 1.0, 0.3))
    shape = model.puppet_from_joints(given[:, :2], scale, person["view"])
    painted = [
        {"part": model.tree.names[part], "contour": np.round(shape.contours[part], 1).tolist()}
        for part in depth_order(model, person["view"])
    ]
    return {"scale": scale, "parts": painted}


def carried(parts: int, people: list[Person], before: U8, image: U8) -> list[Person]:
    """The people of the image `before` (H, W, 3) where the puppet flow takes them in `image`.

    InputError when the images differ in size or are too small for a flow.
    """
    if before.shape != image.shape:
        raise InputError("the image before has another size; puppets are carried between images of one size")
    flow = OpticalFlow().at_working_scale(before, image)
    moved = []
    for person in people:
        model = body(person["gender"], parts)
        tracker = FlowingPuppetTracker(model, TrackerSettings())
        joints = np.array(person["joints"], dtype=np.float64)
        given = Keypoints(model.joint_names, joints[:, :2], np.ones(len(joints)))
        tracker.step(before, 0, [given])
        found = tracker.step(image, 1, flow=flow).puppets
        if found:
            at = np.where(np.isfinite(found[0].joints), found[0].joints, joints[:, :2])
            moved.append(
                person | {"joints": [[*map(float, xy), int(v)] for xy, v in zip(at, joints[:, 2], strict=True)]}
            )
    return moved
